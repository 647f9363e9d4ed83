"""Configuration: Hydra groups in `conf/`, composed and checked.

A problem parameter is the value of one configuration key (`scene.parameters.key`), so a
simulation at a parameter value is the same configuration with that key replaced.
"""

import difflib
import itertools
import math
import re
import typing
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path

from hydra import compose, initialize_config_dir
from hydra.core.config_loader import ConfigLoader
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override, RangeSweep
from hydra.errors import HydraException, OverrideParseException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import ConfigAttributeError, ConfigKeyError, OmegaConfBaseException
from yaml import MarkedYAMLError, YAMLError

from nsf import targets
from nsf.documents import check_sizes, text_of
from nsf.errors import ConfigError
from nsf.paths import CONF, groups
from nsf.resolvers import resolved
from nsf.targets import build as build
from nsf.targets import build_all as build_all
from nsf.vectors import length as length
from nsf.vectors import number as number
from nsf.vectors import text as text

# conf/hydra/launcher/joblib.yaml takes the place of the launcher's own configuration on purpose.
warnings.filterwarnings(
    "ignore", message=r"\s*'hydra/launcher/joblib' is validated against ConfigStore schema"
)

#: How jobs of a sweep are launched, unless told otherwise: without files of Hydra's own.
_SWEEP = (
    "hydra/launcher=serial",
    "hydra/job_logging=disabled",
    "hydra/hydra_logging=disabled",
    "hydra.output_subdir=null",
    "hydra.sweep.dir=${oc.env:NSF_RUNS,runs}/multirun",
    "hydra.sweep.subdir=.",
)

#: Of a sweep; the largest experiment has some hundred.
_MOST_JOBS = 10_000
#: Raised by Hydra and the yaml parser on files that are no configuration, beside their own errors.
_OF_BROKEN_FILES = (
    YAMLError,
    ValueError,
    RecursionError,
    AttributeError,
    TypeError,
    LookupError,
    AssertionError,
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
            a syntax error, a `_target_` that its key does not expect, or an interpolation that is refused.
    """
    try:
        return checked(_compose(config_name, overrides))
    except (HydraException, OmegaConfBaseException) as error:
        raise ConfigError(_explain(error, config_name, overrides)) from error
    except MarkedYAMLError as error:
        mark = error.problem_mark
        raise ConfigError(f"{mark.name}, line {mark.line + 1}: {error.problem}; correct the yaml") from error
    except _OF_BROKEN_FILES as error:
        for path in sorted(CONF.rglob("*.yaml")):
            text_of(path)  # tells of the one that cannot be read
        told = _explain(error, config_name, overrides)
        raise ConfigError(f"the configuration cannot be composed: {told}") from error


def read(path: Path) -> DictConfig:
    """The configuration of a file that is whole by itself, as a run's; its interpolations stay.

    Raises:
        ConfigError: the file cannot be read, or holds no configuration; see also `load`.
    """
    try:
        config = OmegaConf.create(text_of(path))
    except (OmegaConfBaseException, *_OF_BROKEN_FILES) as error:
        told = (str(error) or type(error).__name__).splitlines()[0]
        raise ConfigError(f"{path} is no configuration: {told}; correct the yaml") from error
    if not isinstance(config, DictConfig):
        raise ConfigError(f"{path} is no configuration: it has no keys; correct the yaml")
    try:
        return checked(config)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from error


def _compose(config_name: str, overrides: Sequence[str]) -> DictConfig:
    check_sizes(CONF)
    config = _with_hydra(config_name, overrides)
    own = _of_hydra(config)
    if own != _default_hydra():
        changed = [f"hydra.{key}" for key, value in own.items() if value != _default_hydra().get(key)]
        raise ConfigError(
            f"the configuration sets {', '.join(changed)}, by which Hydra could be made to run code; "
            "leave it out: only the command line says how jobs are launched"
        )
    del config["hydra"]
    return config


def _with_hydra(config_name: str | None, overrides: Sequence[str]) -> DictConfig:
    GlobalHydra.instance().clear()
    with initialize_config_dir(str(CONF), version_base="1.3"):
        config = compose(config_name, overrides=list(overrides), return_hydra_config=True)
    OmegaConf.set_readonly(config, False)
    OmegaConf.set_struct(config, False)
    return config


def _of_hydra(config: DictConfig) -> dict[str, typing.Any]:
    """Hydra's own part of a configuration, without what it tells of the overrides."""
    own = OmegaConf.to_container(config.hydra)
    own["job"] = {k: v for k, v in own["job"].items() if k not in ("override_dirname", "config_name")}
    return {k: v for k, v in own.items() if k not in ("overrides", "runtime")}


@cache
def _default_hydra() -> dict[str, typing.Any]:
    return _of_hydra(_with_hydra(None, ()))


def checked(config: DictConfig) -> DictConfig:
    """The configuration with its interpolations, once it is sure that all of them resolve.

    Raises:
        ConfigError: see `load`.
    """
    resolve(config)
    return OmegaConf.create(OmegaConf.to_container(config))


def resolve(config: DictConfig) -> DictConfig:
    """Replace every interpolation by its value and check targets and missing values.

    Raises:
        ConfigError: see `load`.
    """
    try:
        plain = resolved(config)
        targets.check(plain)
        return OmegaConf.create(plain)
    except RecursionError as error:
        raise ConfigError("the configuration is nested too deeply; flatten it") from error


@contextmanager
def naming_the_missing() -> Iterator[None]:
    """Say which key is missing that the block reads from a configuration.

    Raises:
        ConfigError: one is missing.
    """
    try:
        yield
    except (ConfigAttributeError, ConfigKeyError) as error:
        raise ConfigError(f"{error.full_key} is missing from the configuration; give it a value") from error


def section(config: DictConfig, key: str) -> DictConfig:
    """The keys below a key.

    Raises:
        ConfigError: it is missing, or holds something else.
    """
    found = OmegaConf.select(config, key)
    if not isinstance(found, DictConfig):
        raise ConfigError(f"{key}={'null' if found is None else found} must map keys to values")
    return found


def of_launcher(override: str) -> bool:
    """Whether an override is about how jobs are launched, as `hydra/launcher=slurm`, and not about a job."""
    return override.lstrip("+~").startswith(("hydra/", "hydra."))


def launching(overrides: Sequence[str], config_name: str = "config") -> tuple[DictConfig, ConfigLoader]:
    """The configuration from which Hydra launches jobs, and what composes each of them.

    Args:
        overrides: Hydra's own, as `hydra/launcher=slurm`, `hydra.launcher.partition=gpu`.
        config_name: as for `load`.

    Raises:
        ConfigError: an unknown key or launcher, with the nearest known one.
    """
    GlobalHydra.instance().clear()
    with initialize_config_dir(str(CONF), version_base="1.3", job_name="nsf"):
        hydra = GlobalHydra.instance().hydra
        try:
            config = hydra.compose_config(
                config_name, [*_SWEEP, *overrides], RunMode.MULTIRUN, with_log_configuration=False
            )
        except HydraException as error:
            raise ConfigError(_explain(error, config_name, overrides)) from error
        return config, hydra.config_loader


def jobs(sweeps: Sequence[Sequence[str]], config_name: str = "config") -> list[tuple[str, ...]]:
    """The overrides of every job of sweeps, each job once: every combination of a sweep's values.

    Jobs of one scene follow each other, so that its trajectories can go when the next one's come.

    Raises:
        ConfigError: a syntax error, an interval of values, or more jobs than anyone can mean.
    """
    options = [_options(overrides, config_name) for overrides in sweeps]
    if (count := sum(math.prod(map(len, values)) for values in options)) > _MOST_JOBS:
        raise ConfigError(f"{count} jobs are more than the {_MOST_JOBS} of a sweep; give fewer values")
    found = list(dict.fromkeys(job for values in options for job in itertools.product(*values)))
    scenes = [scene_of(job) for job in found]
    return [job for _, job in sorted(zip(scenes, found, strict=True), key=lambda one: scenes.index(one[0]))]


def scene_of(job: Sequence[str]) -> str:
    """The override of a job that names its scene; empty where none does."""
    return next((override for override in job if override.startswith("scene=")), "")


def _options(overrides: Sequence[str], config_name: str) -> list[list[str]]:
    """The overrides of a multirun, each as the list of single ones that it stands for; of a key, the last."""
    GlobalHydra.instance().clear()
    with initialize_config_dir(str(CONF), version_base="1.3"):
        parser = OverridesParser.create(GlobalHydra.instance().config_loader())  # which glob(*) looks through
    try:
        parsed = parser.parse_overrides(list(overrides))
    except (HydraException, RecursionError) as error:
        raise ConfigError(_explain(error, config_name, overrides)) from error
    options: dict[str, list[str]] = {}
    for override in parsed:
        key = override.get_key_element()
        options[key] = [override.input_line]
        if override.is_sweep_override():
            if not override.is_discrete_sweep():
                raise ConfigError(f"{override.input_line} has no end of values; list them, or use nsf search")
            options[key] = [f"{key}={value}" for value in _values(override)]
    return list(options.values())


def _values(override: Override) -> list[str]:
    """The values of an override that has several."""
    try:
        if isinstance(several := override.value(), RangeSweep):
            found = list(itertools.islice(several.range(), _MOST_JOBS + 1))  # a shuffled one would be listed
        if not isinstance(several, RangeSweep) or len(found) <= _MOST_JOBS:
            found = list(override.sweep_string_iterator())
    except (HydraException, ValueError, ArithmeticError) as error:
        raise ConfigError(f"{override.input_line}: {error}; give start, stop and step") from error
    if len(found) > _MOST_JOBS:
        raise ConfigError(f"{override.input_line} has more than {_MOST_JOBS} values; give fewer")
    return found


def check_sweep(
    overrides: Sequence[str], config_name: str = "config", check: Callable[[DictConfig], object] | None = None
) -> None:
    """Compose with each value of a multirun once, so that a mistake shows before the first job.

    Args:
        overrides, config_name: as for `load`; overrides may have several values.
        check: called with each configuration; raises where it refuses one.

    Raises:
        ConfigError: see `load`; and whatever `check` raises.
    """
    options = _options(overrides, config_name)
    first = [values[0] for values in options]
    for at, values in enumerate(options):
        for value in values:
            config = load([*first[:at], value, *first[at + 1 :]], config_name)
            if check is not None:
                check(config)


def replaced(config: DictConfig, values: Mapping[str, typing.Any], known: Sequence[str]) -> DictConfig:
    """A copy with other values of some keys; a key that refers to a replaced one follows.

    Args:
        config: composed, its interpolations kept.
        values: by dotted key.
        known: keys that may be replaced, as of `leaves`.

    Raises:
        ConfigError: an unknown key, with the nearest known one, or one that holds others.
    """
    config = config.copy()
    for key, value in values.items():
        if key not in known:
            inner = [k for k in known if k.startswith(f"{key}.")]
            near = inner or difflib.get_close_matches(key, known, n=3, cutoff=0.5)
            hint = f"did you mean {' or '.join(near[:3])}?" if near else "give a dotted key, as scene.gravity"
            raise ConfigError(f"{'several keys in' if inner else 'unknown key'} {key!r}; {hint}")
        OmegaConf.update(config, key, value)
    return config


def leaves(node, prefix: str = "") -> list[str]:
    """Dotted keys of a plain tree that hold values, and those that a `_target_` has a default for."""
    if not isinstance(node, dict):
        return [prefix]
    path = tuple(prefix.split("."))
    unset = targets.keys_of(node["_target_"], path) if "_target_" in node else []
    return [
        key
        for name, child in (dict.fromkeys(unset) | node).items()
        if not name.startswith("_")
        for key in leaves(child, f"{prefix}.{name}" if prefix else name)
    ]


def _keys(node, prefix: str = "") -> list[str]:
    if not isinstance(node, dict):
        return [prefix]
    return [prefix] * bool(prefix) + [
        k for n, v in node.items() for k in _keys(v, f"{prefix}.{n}" if prefix else n)
    ]


def _explain(error: Exception, config_name: str, overrides: Sequence[str]) -> str:
    """Hydra's message in one line, with the nearest known key."""
    text = str(error)
    first = (text.splitlines() or ["a value cannot be read; check quotes, brackets and ${…}"])[0]
    missing = re.search(r"Could not override '([^']+)'", text)
    if missing:
        key = missing.group(1)
        if key == "experiment":
            return "an experiment is named with a plus: +experiment=NAME"
        others = [o for o in overrides if not o.lstrip("+~").startswith(key)]
        known = _known_keys(config_name, others, of_launcher(key))
        if key in known:
            return f"{key!r} takes no keys beyond its own; set them one by one, or write a scene's yaml"
        near = difflib.get_close_matches(key, known, n=3, cutoff=0.5)
        hint = f"; did you mean {' or '.join(near)}?" if near else "; see `nsf --help` for the groups"
        return f"unknown key {key!r}{hint}"
    if isinstance(error, OverrideParseException):
        return f"{error.override!r} is not Hydra's key=value ({first}); quote brackets, commas and spaces"
    if first.startswith("Ambiguous value"):
        return f"{first}; several values of a key need -m"
    nameless = [o for o in overrides if o.startswith("=")]
    if nameless:
        return f"{nameless[0]!r} has no key; give key=value"
    if "Config group override must be" in first:
        pairs = (o.lstrip("+").split("=", 1) for o in overrides if "=" in o)
        told = [f"{group}={name}" for group, name in pairs if name not in groups().get(group, [name])]
        if told:
            return f"{told[0]} names no option of its group; `nsf --help` lists them"
    if first.startswith("Error merging override") and error.__cause__ is not None:
        return f"{first.removeprefix('Error merging override ')}: {str(error.__cause__).splitlines()[0]}"
    option = re.search(r"Could not find '([^']+)'", text)
    group = max((g for g in groups() if option and option[1].startswith(f"{g}/")), key=len, default=None)
    if option and group:
        name, known = option[1].removeprefix(f"{group}/"), groups()[group]
        near = difflib.get_close_matches(name, known, n=1)
        return f"unknown {group}={name}; choose one of {', '.join(known)}" + (
            f" (did you mean {near[0]}?)" if near else ""
        )
    return first


def _known_keys(config_name: str, overrides: Sequence[str], launcher: bool) -> list[str]:
    try:
        config = launching(overrides, config_name)[0] if launcher else _compose(config_name, overrides)
    except HydraException:
        return list(groups())
    return _keys(OmegaConf.to_container(config, resolve=False))
