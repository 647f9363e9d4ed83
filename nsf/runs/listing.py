"""Runs as they are listed, filtered and sorted: from manifests and configurations alone."""

import difflib
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from dataclasses import field as attribute
from fnmatch import fnmatchcase
from functools import cache, cached_property
from pathlib import Path
from typing import Any

from nsf.errors import ConfigError
from nsf.paths import groups, option
from nsf.runs.run import Run

#: What a user sees of each run first.
FIELDS = ("stage", "scene", "id", "created", "status", "seconds", "metric")
#: The metric that stands for a stage, and how it is told.
MAIN = {
    "evaluate": ("delta", "δ"),
    "superresolve": ("delta", "δ"),
    "train": ("deformation_loss", "loss of g"),
}
#: What is shown in place of a value that is not there.
ABSENT = "–"
#: Groups whose option a run's settings tell, by the class that it names.
_GROUPS = ("field", "trainer", "sampler", "projector", "integration")
_GENERATIONS = 32  # of runs, each made from the one before; a chain has five
ORIGIN = ("commit", "dirty", "device", "seed", "precision", "versions")


@dataclass(frozen=True)
class Entry:
    """A run as it is listed.

    Attributes:
        run: whole, half-made or broken.
        known: settings of runs by run, which entries that are listed together share.
    """

    run: Run
    known: dict[Run, dict[str, Any]] = attribute(default_factory=dict, repr=False, compare=False)

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
        """The configuration by dotted key: of the runs that this one goes back to, and on top its own.

        Where those runs differ, as simulations do in their parameter, the values are a tuple. A broken run
        has none. Groups are there by the option that was chosen, such as `field` and `method`.
        """
        return _with_options(_settings(self.run, self.known, _GENERATIONS))


def entries(filters: Mapping[str, str] | None = None, sort: str = "-created", root: Path | None = None):
    """The runs that pass every filter, sorted.

    Args:
        filters: by field, metric or key of the configuration (of the run or those it goes back to): the
            value it must have; several are parted by commas, and `*` stands for anything.
        sort: field, metric or key; from the largest down with a leading `-`. Runs without it come last.
        root: folder of all runs; NSF_RUNS, else ./runs.

    Returns:
        A list of `Entry`.

    Raises:
        ConfigError: there are runs, and none has such a key; names the nearest.
    """
    known: dict[Run, dict[str, Any]] = {}
    found = [Entry(run, known) for run in Run.find(root=root)]
    key = sort.removeprefix("-")
    for name in (*(filters or ()), key):
        _check_key(name, found)
    for name, wanted in (filters or {}).items():
        found = [entry for entry in found if _matches(value_of(entry, name), wanted)]
    there = [entry for entry in found if value_of(entry, key) is not None]
    there.sort(key=lambda entry: _order(value_of(entry, key)), reverse=sort.startswith("-"))
    return there + [entry for entry in found if value_of(entry, key) is None]


def _settings(run: Run, known: dict[Run, dict[str, Any]], generations: int) -> dict[str, Any]:
    """As `Entry.settings`; `known` ends the search where a run goes back to itself."""
    if run in known:
        return known[run]
    if not generations:
        return {}
    known[run] = {}
    if not run.manifest or run.fault:
        return {}
    found: dict[str, list[Any]] = {}
    for parent in run.parent_runs:
        for key, value in _settings(parent, known, generations - 1).items():
            values = found.setdefault(key, [])
            values += [v for v in (value if isinstance(value, tuple) else (value,)) if v not in values]
    inherited = {key: values[0] if len(values) == 1 else tuple(values) for key, values in found.items()}
    known[run] = inherited | flat(run.config)
    return known[run]


def _with_options(settings: dict[str, Any]) -> dict[str, Any]:
    """Settings with the option of each group that they come from."""
    found = {group: _option(group, settings) for group in _GROUPS}
    found["model"] = settings.get("model.name")
    return settings | {group: option for group, option in found.items() if option is not None}


def _option(group: str, settings: dict[str, Any]) -> str | None:
    """The option that settings come from: of those of their class that whose keys, then values, fit best.

    A class that no option of this checkout has is told by its name.
    """
    target = settings.get(f"{group}._target_")
    if not isinstance(target, str):
        return None
    options = _options(group).get(target, {})
    own = {key.split(".")[1]: value for key, value in settings.items() if key.startswith(f"{group}.")}

    def fit(option: str) -> tuple[int, int, int]:
        keys = options[option]
        alike = sum(text(own.get(key)) == value for key, value in keys.items())
        return -len(keys.keys() - own.keys()), len(keys), alike

    return max(options, key=fit, default=target.rpartition(".")[2])


@cache
def _options(group: str) -> dict[str, dict[str, dict[str, str]]]:
    """The options of each class of a group, with their keys and values as they stand."""
    found: dict[str, dict[str, dict[str, str]]] = {}
    for path in (option(group, name) for name in groups().get(group, ())):
        keys = dict(
            re.findall(r"^(\w+):[ \t]*([^\n#]*?)[ \t]*(?:#.*)?$", path.read_text(encoding="utf-8"), re.M)
        )
        if target := keys.pop("_target_", None):
            found.setdefault(target, {})[path.stem] = keys
    return found


def _check_key(key: str, found: Sequence[Entry]) -> None:
    if not found or key in FIELDS or any(key in entry.values or key in entry.settings for entry in found):
        return
    known = dict.fromkeys([*FIELDS, *(k for entry in found for k in (*entry.values, *entry.settings))])
    near = difflib.get_close_matches(key, known, n=3, cutoff=0.5)
    hint = f"did you mean {' or '.join(near)}?" if near else f"choose {', '.join(FIELDS)}, a metric or a key"
    raise ConfigError(f"no run has {key!r}; {hint}")


def value_of(entry: Entry, key: str):
    """A field, metric or setting of a run; None where it has none."""
    found = entry.values.get(key)
    return entry.settings.get(key) if found is None else found


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
