"""Configurations as a user asks for them: of overrides or of a file; what is wrong with them in one line.

A problem parameter is the value of one configuration key (`scene.parameters.NAME.key`), so a
simulation of a case is the same configuration with these keys replaced.
"""

import difflib
import re
import warnings
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from hydra.core.config_loader import ConfigLoader
from hydra.core.global_hydra import GlobalHydra
from hydra.errors import HydraException, OverrideParseException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import MarkedYAMLError

from nsf.config.composing import (
    OF_BROKEN_FILES,
    check,
    checked,
    composed,
    initialized,
    missing_key,
    of_launcher,
    unlocked,
    with_values,
)
from nsf.config.documents import check_sizes, text_of
from nsf.config.removed import refuse_overrides
from nsf.config.resolvers import leaves
from nsf.errors import ConfigError, first_line, unknown
from nsf.paths import REMEDY, files, groups

# conf/hydra/launcher/joblib.yaml takes the place of the launcher's own configuration on purpose.
warnings.filterwarnings(
    "ignore", message=r"\s*'hydra/launcher/joblib' is validated against ConfigStore schema"
)

#: Of Hydra's launchers: no files of Hydra's, and loggers left alone.
_SWEEP = (
    "hydra/job_logging=none",
    "hydra/hydra_logging=none",
    "hydra.output_subdir=null",
    "hydra.sweep.dir=${oc.env:NSF_RUNS,runs}/multirun",
    "hydra.sweep.subdir=.",
)


def load(overrides: Sequence[str] = (), config_name: str = "config") -> DictConfig:
    """Compose the configuration from Hydra overrides and check it.

    Interpolations stay, so that a key that is replaced later (the problem parameter) is seen by
    every key that refers to it.

    Args:
        overrides: `key=value` in Hydra's grammar, for example `scene=sand`, `scene.dt=0.001`.
        config_name: the primary file in `conf/`.

    Raises:
        ConfigError: unknown key or option (with the nearest known one), a missing value,
            a syntax error, a `_target_` that its key does not expect, an interpolation that is refused,
            or a key that was removed.
    """
    refuse_overrides(overrides)
    try:
        config = composed(config_name, overrides)
        check(config)
        return config
    except (HydraException, OmegaConfBaseException) as error:
        raise ConfigError(explained(error, config_name, overrides)) from error
    except MarkedYAMLError as error:
        mark = error.problem_mark
        raise ConfigError(f"{mark.name}, line {mark.line + 1}: {error.problem}; correct the yaml") from error
    except OF_BROKEN_FILES as error:
        for path in files():
            text_of(path)  # tells of the one that cannot be read
        reason = explained(error, config_name, overrides)
        culprit = _culprit(config_name, overrides)
        raise ConfigError(f"the configuration cannot be composed{culprit}: {reason}") from error


def _culprit(config_name: str, overrides: Sequence[str]) -> str:
    """The override of a key without which the rest can be composed, as a part of a message."""
    for override in (o for o in overrides if "." in o.partition("=")[0]):
        rest = [o for o in overrides if o != override]
        with suppress(HydraException, OmegaConfBaseException, ConfigError, *OF_BROKEN_FILES):
            if with_values(config_name, rest, check_sizes(files())):
                return f" with {override}"
    return ""


def read(path: Path) -> DictConfig:
    """The configuration of a file that is whole by itself, as a run's; its interpolations stay.

    Raises:
        ConfigError: the file cannot be read, or holds no configuration; see also `load`.
    """
    try:
        config = OmegaConf.create(text_of(path))
    except (OmegaConfBaseException, *OF_BROKEN_FILES) as error:
        raise ConfigError(f"{path} is no configuration: {first_line(error)}; correct the yaml") from error
    if not isinstance(config, DictConfig):
        raise ConfigError(f"{path} is no configuration: it has no keys; correct the yaml")
    try:
        return checked(config)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from error


def launching(overrides: Sequence[str], config_name: str = "config") -> tuple[DictConfig, ConfigLoader]:
    """The configuration from which Hydra launches jobs, and what composes each of them.

    Args:
        overrides: Hydra's own, as `hydra/launcher=slurm`, `hydra.launcher.partition=gpu`.
        config_name: as for `load`.

    Raises:
        ConfigError: an unknown key or launcher, with the nearest known one.
    """
    with initialized(job_name="nsf"):
        hydra = GlobalHydra.instance().hydra
        try:
            config = hydra.compose_config(
                config_name, [*_SWEEP, *overrides], RunMode.MULTIRUN, with_log_configuration=False
            )
        except HydraException as error:
            raise ConfigError(explained(error, config_name, overrides)) from error
        return config, hydra.config_loader


def _unparsed(override: str, first: str) -> str:
    """Why Hydra does not read an override, and how to write it; a shell takes one pair of quotes away."""
    key, _, value = override.partition("=")
    if value != (shorter := value.strip(",")):
        return f"{override!r} has a comma too many; write {key}={shorter}"
    if re.fullmatch(r"[+~\w.@/]+", key) and value and not re.search(r"['\"{}\[\]$\\]", value):
        return f"{override!r} needs quotes of Hydra's inside those of the shell; write '{key}=\"{value}\"'"
    return f"{override!r} is not Hydra's key=value ({first}); quote brackets, commas and spaces"


def _unknown(key: str, config_name: str, overrides: Sequence[str]) -> str:
    """The message about a key that no file sets."""
    others = [o for o in overrides if not o.lstrip("+~").startswith(key)]
    if of_launcher(key):
        tree = OmegaConf.to_container(launching(others, config_name)[0])
        return unknown(key, [".".join(path) for path, _ in leaves(tree)])
    added = [f"+{o}" if o.startswith(f"{key}=") else o for o in overrides]
    try:
        mapping = any(o.startswith(f"{key}={{") for o in overrides)
        if mapping and OmegaConf.select(composed(config_name, others), key) is not None:
            return f"{key!r} takes no keys beyond its own; set them one by one, or write a scene's yaml"
        checked(unlocked(config_name, added))
    except ConfigError as error:
        return str(error)
    except HydraException as error:
        other = missing_key(error)
        return first_line(error) if other in (None, key) else _unknown(other, config_name, added)
    keys = _keys(config_name, others)
    parents = [key[:at] for at, letter in enumerate(key) if letter == "."]
    if gone := [parent for parent in parents if parent not in keys]:
        return unknown(gone[0], keys)
    return f"no file sets {key!r}; add it with a plus, +{key}=…"


def _keys(config_name: str, overrides: Sequence[str]) -> dict[str, None]:
    """Every dotted key of a composed configuration, also of those that hold others."""
    tree = OmegaConf.to_container(composed(config_name, overrides))
    return {".".join(path[: n + 1]): None for path, _ in leaves(tree) for n in range(len(path))}


def explained(error: Exception, config_name: str, overrides: Sequence[str]) -> str:
    """Hydra's message in one line, with the nearest known key."""
    text = str(error)
    first = (text.splitlines() or ["a value cannot be read; check quotes, brackets and ${…}"])[0]
    if key := missing_key(error):
        if key == "experiment":
            return "an experiment is named with a plus: +experiment=NAME"
        return _unknown(key, config_name, overrides)
    if missing := re.search(r"Could not delete from config. '([^']+)' does not exist", text):
        others = [o for o in overrides if o.lstrip("~").partition("=")[0] != missing[1]]
        return unknown(missing[1], _keys(config_name, others))
    if isinstance(error, OverrideParseException):
        return _unparsed(str(error.override), first)
    if first.startswith("Could not append to config"):
        return f"{first.rstrip('.')}; leave out the plus, or quote braces for the shell"
    if first.startswith("Ambiguous value"):
        return f"{first}; several values of a key need -m"
    if "hydra.searchpath" in text:
        return f"hydra.searchpath is refused; {REMEDY}"
    if first.startswith("You must specify"):
        gone = [o for o in overrides if o.startswith("~") and o[1:].partition("=")[0] in groups()]
        return f"{gone[0]} leaves nothing in its place; choose an option" if gone else first
    if "raised while composing config" in first:
        return f"{first} {text.splitlines()[1]}; a file of a group maps keys to values"
    nameless = [o for o in overrides if o.startswith("=")]
    if nameless:
        return f"{nameless[0]!r} has no key; give key=value"
    if "Config group override must be" in first:
        pairs = (o.lstrip("+").split("=", 1) for o in overrides if "=" in o)
        options = [f"{group}={name}" for group, name in pairs if name not in groups().get(group, [name])]
        if options:
            return f"{options[0]} names no option of its group; `nsf run --help` lists them"
    if first.startswith("Error merging override") and error.__cause__ is not None:
        return f"{first.removeprefix('Error merging override ')}: {str(error.__cause__).splitlines()[0]}"
    option = re.search(r"Could not find '([^']+)'", text)
    group = max((g for g in groups() if option and option[1].startswith(f"{g}/")), key=len, default=None)
    if option and group:
        name, names = option[1].removeprefix(f"{group}/"), groups()[group]
        near = difflib.get_close_matches(name, names, n=1)
        if Path("conf", group, f"{name}.yaml").is_file():
            return f"unknown {group}={name}; conf has it: add --config-dir conf"
        hint = f" (did you mean {near[0]}?)" if near else ""
        return f"unknown {group}={name}; choose one of {', '.join(names)}{hint}"
    return first
