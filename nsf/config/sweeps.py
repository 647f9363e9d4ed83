"""Sweeps: the jobs that overrides with several values stand for, checked before the first begins."""

import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any

from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override, RangeSweep
from hydra.errors import HydraException
from omegaconf import DictConfig

from nsf.config.composing import initialized
from nsf.config.loading import explained, load
from nsf.errors import ConfigError

#: Of a sweep; the largest experiment has some hundred.
_MOST_JOBS = 10_000


def jobs(sweeps: Sequence[Sequence[str]], config_name: str = "config") -> list[tuple[str, ...]]:
    """The overrides of every job of sweeps, each job once: every combination of a sweep's values.

    Jobs of one scene follow each other, so that its trajectories can go when the next one's come.

    Raises:
        ConfigError: a syntax error, an interval of values, or more jobs than anyone can mean.
    """
    options = [_options(overrides, config_name) for overrides in sweeps]
    if (count := sum(math.prod(map(len, values)) for values in options)) > _MOST_JOBS:
        raise ConfigError(f"{count} jobs are more than the {_MOST_JOBS} of a sweep; give fewer values")
    combinations = list(dict.fromkeys(job for values in options for job in itertools.product(*values)))
    scenes = [scene_of(job) for job in combinations]
    pairs = sorted(zip(scenes, combinations, strict=True), key=lambda pair: scenes.index(pair[0]))
    return [job for _, job in pairs]


def scene_of(job: Sequence[str]) -> str:
    """The override of a job that names its scene; empty where none does."""
    return next((override for override in job if override.startswith("scene=")), "")


def _options(overrides: Sequence[str], config_name: str) -> list[list[str]]:
    """The overrides of a multirun, each as the list of single ones that it stands for; of a key, the last."""
    with initialized():
        parser = OverridesParser.create(GlobalHydra.instance().config_loader())  # which glob(*) looks through
    try:
        parsed = parser.parse_overrides(list(overrides))
    except (HydraException, RecursionError) as error:
        raise ConfigError(explained(error, config_name, overrides)) from error
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
            values = list(itertools.islice(several.range(), _MOST_JOBS + 1))  # a shuffled one would be listed
        if not isinstance(several, RangeSweep) or len(values) <= _MOST_JOBS:
            values = list(override.sweep_string_iterator())
    except (HydraException, ValueError, ArithmeticError) as error:
        raise ConfigError(f"{override.input_line}: {error}; give start, stop and step") from error
    if len(values) > _MOST_JOBS:
        raise ConfigError(f"{override.input_line} has more than {_MOST_JOBS} values; give fewer")
    return values


def grammar(value: Any) -> str:
    """A plain value in Hydra's grammar."""
    if isinstance(value, list | tuple):
        return f"[{','.join(map(grammar, value))}]"
    if isinstance(value, dict):
        return "{" + ",".join(f"{key}:{grammar(one)}" for key, one in value.items()) + "}"
    return "null" if value is None else str(value).lower() if isinstance(value, bool) else str(value)


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
    each = ((*first[:at], value, *first[at + 1 :]) for at, values in enumerate(options) for value in values)
    for job in dict.fromkeys(each):
        config = load(job, config_name)
        if check is not None:
            check(config)
