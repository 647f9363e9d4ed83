"""Runs as they are listed, filtered and sorted: from manifests and configurations alone."""

import difflib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import yaml

from nsf.errors import ConfigError
from nsf.manifest import STAGES, STATUSES
from nsf.paths import groups, option
from nsf.runs.run import Run

#: What a user sees of each run first.
FIELDS = ("stage", "scene", "id", "created", "status", "seconds", "metric")
#: The metric that stands for a stage, and its title.
MAIN = {
    "evaluate": ("displacement_error", "error"),
    "superresolve": ("displacement_error", "error"),
    "train": ("deformation_loss", "loss of g"),
    "deploy": ("light", "error bounds"),
}
#: Shown in place of a value that a run lacks.
ABSENT = "–"
#: Groups whose option a run's settings tell, by the class that they name.
_GROUPS = ("field", "trainer", "sampler", "projector", "integration")
_GENERATIONS = 32  # of runs, each made from the one before; a chain has five
_MOST = 8  # values that a sentence names
ORIGIN = ("commit", "dirty", "device", "seed", "precision", "versions")


@dataclass(frozen=True)
class Entry:
    """A run as it is listed.

    Attributes:
        run: whole, half-made or broken.
        cache: settings by run, which entries that are listed together share.
    """

    run: Run
    cache: dict[Run, dict[str, Any]] = field(default_factory=dict, repr=False, compare=False)

    @cached_property
    def fault(self) -> str | None:
        """Why the run is broken, None where it is not."""
        return self.run.fault

    @cached_property
    def manifest(self) -> dict[str, Any]:
        """The run's manifest."""
        return self.run.manifest

    @cached_property
    def values(self) -> dict[str, Any]:
        """Fields, numbers unformatted, and metrics by their names."""
        main, _ = MAIN.get(self.run.stage, (None, None))
        fields = {
            "stage": self.run.stage,
            "scene": self.run.scene,
            "id": self.run.hash,
            "created": self.manifest.get("created"),
            "status": self.run.status,
            "seconds": self.manifest.get("seconds"),
            "metric": self.metrics.get(main),
        }
        return {key: self.manifest.get(key) for key in ORIGIN} | self.metrics | fields

    @cached_property
    def metrics(self) -> dict[str, Any]:
        """The manifest's metrics, one number or text a key."""
        return flat(self.manifest.get("metrics") or {})

    @cached_property
    def settings(self) -> dict[str, Any]:
        """The run's configuration by dotted key, over that of the runs that it was made from.

        Where those runs differ, as simulations do in their parameter, the values are a tuple. A broken run
        has none. Groups are named by their option, as `field` and `sampler`.
        """
        settings = _settings(self.run, self.cache, _GENERATIONS)
        options = {group: _option(group, settings) for group in _GROUPS}
        options["model"] = settings.get("model.name")
        return settings | {group: name for group, name in options.items() if name is not None}


def entries(
    filters: Mapping[str, str] | None = None, sort: str = "-created", root: Path | None = None
) -> list[Entry]:
    """The runs that pass every filter, sorted.

    Args:
        filters: by field, metric or key of the configuration (of the run or those it was made from): the
            value it must have; several are parted by commas, and `*` stands for anything.
        sort: field, metric or key; from the largest down with a leading `-`. Runs without it come last.
        root: folder of all runs; NSF_RUNS, else ./runs.

    Raises:
        ConfigError: there are runs, and none has such a key; or no run can have such a value of a field or a
            group. Names those that there are.
    """
    return chosen(listed(root), filters or {}, sort)


def listed(root: Path | None = None) -> list[Entry]:
    """Every run, the newest first."""
    cache: dict[Run, dict[str, Any]] = {}
    return [Entry(run, cache) for run in Run.find(root=root)]


def chosen(every: Sequence[Entry], filters: Mapping[str, str], sort: str) -> list[Entry]:
    """Those of the listed runs that pass every filter, sorted, as `entries` says."""
    key = sort.removeprefix("-")
    for name, wanted in filters.items():
        _check_value(name, wanted, every)
    for name in (*filters, key):
        _check_key(name, every)
    matching = [
        entry
        for entry in every
        if all(_matches(value_of(entry, name), wanted) for name, wanted in filters.items())
    ]
    valued = [entry for entry in matching if value_of(entry, key) is not None]
    valued.sort(key=lambda entry: _order(value_of(entry, key)), reverse=sort.startswith("-"))
    return valued + [entry for entry in matching if value_of(entry, key) is None]


def _settings(run: Run, cache: dict[Run, dict[str, Any]], generations: int) -> dict[str, Any]:
    """Settings without options of groups; `cache` ends the search where a run goes back to itself."""
    if run in cache:
        return cache[run]
    if not generations:
        return {}
    cache[run] = {}
    if not run.manifest or run.fault:
        return {}
    several: dict[str, list[Any]] = {}
    for parent in run.parent_runs:
        for key, value in _settings(parent, cache, generations - 1).items():
            values = several.setdefault(key, [])
            values += [v for v in (value if isinstance(value, tuple) else (value,)) if v not in values]
    inherited = {key: values[0] if len(values) == 1 else tuple(values) for key, values in several.items()}
    cache[run] = inherited | flat(run.config)
    return cache[run]


def _option(group: str, settings: dict[str, Any]) -> str | None:
    """The option of a group that settings come from: of those of their class the one they share most with.

    A class that no option of this checkout has is called by its name.
    """
    target = settings.get(f"{group}._target_")
    if not isinstance(target, str):
        return None
    names = {key.split(".")[1] for key in settings if key.startswith(f"{group}.")}

    def shared(keys: dict[str, Any]) -> tuple[int, int]:
        alike = sum(settings.get(f"{group}.{key}") == value for key, value in keys.items())
        return -len(keys.keys() ^ names), alike

    options = {name: keys for name, keys in _options(group).items() if keys["_target_"] == target}
    return max(options, key=lambda name: shared(options[name]), default=target.rpartition(".")[2])


@cache
def _options(group: str) -> dict[str, dict[str, Any]]:
    """The keys and values of each option of a group that names a class."""
    files = {name: option(group, name).read_text(encoding="utf-8") for name in groups().get(group, ())}
    options = {name: yaml.safe_load(text) for name, text in files.items()}
    return {name: keys for name, keys in options.items() if isinstance(keys, dict) and "_target_" in keys}


def _check_key(key: str, listed: Sequence[Entry]) -> None:
    if not listed or key in FIELDS or any(key in entry.values or key in entry.settings for entry in listed):
        return
    keys = dict.fromkeys([*FIELDS, *(k for entry in listed for k in (*entry.values, *entry.settings))])
    near = difflib.get_close_matches(key, keys, n=3, cutoff=0.5)
    hint = f"did you mean {' or '.join(near)}?" if near else f"choose {', '.join(FIELDS)}, a metric or a key"
    raise ConfigError(f"no run has {key!r}; {hint}")


def _check_value(key: str, wanted: str, listed: Sequence[Entry]) -> None:
    """Refuse a value that no run can have, of keys whose values are known."""
    fields = {"stage": STAGES, "status": (*STATUSES, "killed", "incomplete", "broken", "missing")}
    if (values := fields.get(key) or groups().get(key)) is None:
        return
    values = list(dict.fromkeys([*values, *_values(key, listed)]))
    for pattern in wanted.split(","):
        if not any(fnmatchcase(value, pattern) for value in (*values, ABSENT)):
            raise ConfigError(f"no run can have {key}={pattern}; choose {', '.join(values)}")


def _values(key: str, listed: Sequence[Entry]) -> list[str]:
    """The values that runs have of a key, as shown, each once."""
    values = (value_of(entry, key) for entry in listed)
    each = (one for value in values for one in (value if isinstance(value, tuple) else (value,)))
    return list(dict.fromkeys(text(one) for one in each if one is not None))


def why_none(filters: Mapping[str, str], every: Sequence[Entry]) -> str:
    """A sentence on filters that none of the runs passes: there is no run, or which filter leaves none."""
    if not every:
        return "no runs yet; `nsf run scene=sand` makes some, and NSF_RUNS names another folder"
    none = f"none of {len(every)} runs has"
    for key, wanted in filters.items():
        if not any(_matches(value_of(entry, key), wanted) for entry in every):
            values = _values(key, every)
            more = f" and {len(values) - _MOST} more" if len(values) > _MOST else ""
            others = f"; they have {', '.join(values[:_MOST])}{more}" if values else ""
            return f"{none} {key}={wanted}{others}"
    return f"{none} all of {' '.join(f'{key}={wanted}' for key, wanted in filters.items())}"


def value_of(entry: Entry, key: str):
    """A field, metric or setting of a run; None where it has none."""
    value = entry.values.get(key)
    return entry.settings.get(key) if value is None else value


def _matches(value, wanted: str) -> bool:
    several = value if isinstance(value, tuple) else (value,)
    return any(fnmatchcase(text(one), pattern) for one in several for pattern in wanted.split(","))


def _order(value) -> tuple[int, float, str]:
    """Numbers by size, before text in the order of the alphabet."""
    if isinstance(value, int | float):
        return (0, float(value), "")
    return (1, 0.0, str(value))


def flat(value, prefix: str = "") -> dict[str, Any]:
    """A tree as dotted keys."""
    if not isinstance(value, dict) or not value:
        return {prefix: value} if prefix else {}
    return {
        key: leaf
        for name, child in value.items()
        for key, leaf in flat(child, f"{prefix}.{name}" if prefix else str(name)).items()
    }


def text(value) -> str:
    """A value of a configuration or a manifest as shown, without control characters; several in a row."""
    if isinstance(value, tuple):
        return ", ".join(map(text, value))
    if value is None:
        return ABSENT
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float):
        return f"{value:.6g}"
    return "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in str(value))
