"""Configuration: Hydra groups in `conf/`, composed and checked.

A problem parameter is the value of one configuration key (`scene.parameters.key`), so a
simulation at a parameter value is the same configuration with that key replaced.
"""

import dataclasses
import difflib
import inspect
import itertools
import math
import pkgutil
import re
import types
import typing
import warnings
from collections.abc import Callable, Mapping, Sequence

from hydra import compose, initialize_config_dir
from hydra.core.config_loader import ConfigLoader
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException, OverrideParseException
from hydra.types import RunMode
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import MarkedYAMLError

from nsf.errors import ConfigError, NSFError
from nsf.paths import CONF, groups
from nsf.vectors import direction, rotation, vector


def _scaled(table: DictConfig, *, _root_: DictConfig):
    """`${scaled:{small: a, paper: b}}`: the entry of the scale in force."""
    scale = _root_.scale
    if scale not in table:
        raise ConfigError(f"scale={scale} is unknown here; choose one of {', '.join(map(str, table))}")
    return table[scale]


def _per(count) -> float:
    """`${per:150}` = 1/150."""
    return 1.0 / float(count)


def _turned(values, axis, angle) -> list[float]:
    """`${turned:[1,0,0],[0,1,0],30}`: the vector turned by 30° about the axis, right-handed."""
    matrix = rotation(direction("axis of ${turned:…}", axis), number("angle of ${turned:…}", angle))
    return (matrix @ vector("vector of ${turned:…}", values)).tolist()


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

OmegaConf.register_new_resolver("scaled", _scaled, replace=True)
OmegaConf.register_new_resolver("per", _per, replace=True)
OmegaConf.register_new_resolver("turned", _turned, replace=True)


def load(overrides: Sequence[str] = (), config_name: str = "config") -> DictConfig:
    """Compose the configuration from Hydra overrides and check it.

    Interpolations stay, so that a key that is replaced later (the problem parameter) is seen by
    every key that refers to it.

    Args:
        overrides: `key=value` in Hydra's grammar, for example `scene=sand`, `scene.dt=0.001`.
        config_name: the primary file in `conf/`.

    Raises:
        ConfigError: unknown key or option (with the nearest known one), a missing value,
            a syntax error, or an `_target_` outside `nsf`.
    """
    try:
        return checked(_compose(config_name, overrides))
    except (HydraException, OmegaConfBaseException, ValueError) as error:
        raise ConfigError(_explain(error, config_name, overrides)) from error
    except MarkedYAMLError as error:
        mark = error.problem_mark
        raise ConfigError(f"{mark.name}, line {mark.line + 1}: {error.problem}; correct the yaml") from error


def _compose(config_name: str, overrides: Sequence[str]) -> DictConfig:
    GlobalHydra.instance().clear()
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return compose(config_name, overrides=list(overrides))


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
        config = OmegaConf.create(OmegaConf.to_container(config, resolve=True, throw_on_missing=True))
    except OmegaConfBaseException as error:
        # OmegaConf wraps what a resolver raises; its own words come first in the text.
        detail = re.sub(r"^\w*Error raised while resolving interpolation: ", "", str(error).splitlines()[0])
        raise ConfigError(detail) from error
    check_targets(config)
    return config


_REFUSED = "_target_: {} is refused; only nsf.* classes are built from a configuration"


def check_targets(config: DictConfig) -> list[str]:
    """Refuse an `_target_` whose name is not of this package: configuration is not code.

    Returns:
        Every target.

    Raises:
        ConfigError: names the target.
    """
    stack, found = [OmegaConf.to_container(config, resolve=False)], []
    while stack:
        node = stack.pop()
        if isinstance(node, dict):
            if (target := node.get("_target_")) is not None:
                if not re.fullmatch(r"nsf(\.\w+)+", str(target)):
                    raise ConfigError(_REFUSED.format(target))
                found.append(target)
            stack.extend(node.values())
        elif isinstance(node, list):
            stack.extend(node)
    return found


def _load_targets(config: DictConfig, where: str) -> None:
    """Load every `_target_`; what a module of this package only imports is not part of it.

    Raises:
        ConfigError: one does not exist, or is refused.
    """
    for target in check_targets(config):
        try:
            found = pkgutil.resolve_name(target)
        except (ImportError, AttributeError, ValueError) as error:
            raise ConfigError(f"{where}: _target_: {target} does not exist ({error})") from error
        if not str(getattr(found, "__module__", "")).startswith("nsf."):
            raise ConfigError(_REFUSED.format(target))


def build(config: DictConfig, where: str):
    """Instantiate the `_target_` of a configuration node.

    Raises:
        ConfigError: no `_target_`, a misspelt key, or a value that the class refuses; names the node.
    """
    _load_targets(config, where)
    if "_target_" not in config:
        raise ConfigError(f"{where} names no class; give it a _target_: nsf.…")
    _check_types(config, where)
    try:
        return instantiate(config, _convert_="all")
    except HydraException as error:
        cause = error.__cause__
        if isinstance(cause, NSFError):
            raise type(cause)(f"{where}: {cause}") from error
        detail = str(cause or error).splitlines()[0]
        if isinstance(cause, TypeError) and "unexpected keyword" in detail:
            raise ConfigError(
                f"{where}: {detail.split('got an ')[-1]}; known keys: {', '.join(_known(config))}"
            ) from error
        raise ConfigError(f"{where}: {detail}") from error


def _known(config: DictConfig) -> list[str]:
    """Keys that the target of a configuration node takes."""
    return list(inspect.signature(pkgutil.resolve_name(config._target_)).parameters)


_KINDS = {int: "a whole number", float: "a number", bool: "true or false", str: "text"}


def _check_types(config: DictConfig, where: str) -> None:
    """Refuse a value that is not of the type its class declares, as `material.E=soft`.

    Raises:
        ConfigError: names the key and the value.
    """
    target = pkgutil.resolve_name(config._target_)
    hints = typing.get_type_hints(target) if dataclasses.is_dataclass(target) else {}
    for name, hint in hints.items():
        kinds = typing.get_args(hint) if isinstance(hint, types.UnionType) else (hint,)
        if name not in config or not set(kinds) <= {*_KINDS, types.NoneType}:
            continue
        kind, given = type(config[name]), set(kinds)
        if kind not in given and not (kind is int and float in given):
            wanted = " or ".join(_KINDS[k] for k in kinds if k in _KINDS)
            raise ConfigError(f"{where}.{name}={config[name]} must be {wanted}")


def number(key: str, value, least: float = -math.inf, whole: bool = False) -> float | int:
    """A finite number of at least `least`.

    Raises:
        ConfigError: quotes the key and the value.
    """
    fits = isinstance(value, int if whole else int | float) and not isinstance(value, bool)
    if not (fits and math.isfinite(value) and value >= least):
        wanted = "a whole number" if whole else "a finite number"
        raise ConfigError(
            f"{key}={value} must be {wanted}" + (f" of at least {least:g}" if least > -math.inf else "")
        )
    return value


def length(key: str, value) -> float:
    """A positive length [m].

    Raises:
        ConfigError: quotes the key and the value.
    """
    if not number(key, value) > 0:
        raise ConfigError(f"{key}={value} m must be positive")
    return float(value)


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
        ConfigError: a syntax error, or an interval of values.
    """
    options = [_options(overrides, config_name) for overrides in sweeps]
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
    except HydraException as error:
        raise ConfigError(_explain(error, config_name, overrides)) from error
    options: dict[str, list[str]] = {}
    for override in parsed:
        key = override.get_key_element()
        options[key] = [override.input_line]
        if override.is_sweep_override():
            if not override.is_discrete_sweep():
                raise ConfigError(f"{override.input_line} has no end of values; list them, or use nsf search")
            options[key] = [f"{key}={value}" for value in override.sweep_string_iterator()]
    return list(options.values())


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
    unset = _known(OmegaConf.create(node)) if "_target_" in node else []
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
    first = text.splitlines()[0]
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
    option = re.search(r"Could not find '(.+)/([^']+)'", text)
    if option:
        group, name = option.groups()
        known = groups().get(group, [])
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
