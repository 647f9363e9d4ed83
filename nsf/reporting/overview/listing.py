"""Runs in a table, and what differs between two of them: from manifests and configurations alone."""

import difflib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from dataclasses import field as attribute
from datetime import datetime
from fnmatch import fnmatchcase
from functools import cached_property
from pathlib import Path
from typing import Any

from rich.markup import escape
from rich.table import Table

from nsf.errors import ConfigError, SchemaError
from nsf.reporting.text.columns import ABSENT, number
from nsf.runs import Run

#: What a user sees of each run first.
FIELDS = ("stage", "scene", "id", "created", "status", "seconds", "metric")
#: The metric that stands for a stage, and how it is told.
_MAIN = {
    "evaluate": ("delta", "δ"),
    "superresolve": ("delta", "δ"),
    "train": ("deformation_loss", "loss of g"),
}
_GENERATIONS = 32  # of runs, each made from the one before; a chain has five
_ORIGIN = ("commit", "dirty", "device", "seed", "precision", "versions")


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
        main, _ = _MAIN.get(self.run.stage, (None, None))
        fields = {
            "stage": self.run.stage,
            "scene": self.run.scene,
            "id": self.run.hash,
            "created": self.manifest.get("created"),
            "status": self.run.status,
            "seconds": self.manifest.get("seconds"),
            "metric": self.metrics.get(main),
        }
        return {key: self.manifest.get(key) for key in _ORIGIN} | self.metrics | fields

    @cached_property
    def metrics(self) -> dict[str, Any]:
        """The manifest's metrics, one number or text a key."""
        return _flat(self.manifest.get("metrics") or {})

    @cached_property
    def settings(self) -> dict[str, Any]:
        """The configuration by dotted key: of the runs that this one goes back to, and on top its own.

        Where those runs differ, as simulations do in their parameter, the values are a tuple. A broken run
        has none.
        """
        return _settings(self.run, self.known, _GENERATIONS)

    def texts(self) -> list[str]:
        """The fields as shown."""
        shown = {key: text(value) for key, value in self.values.items()}
        if self.values["created"]:
            when = datetime.fromisoformat(self.values["created"]).astimezone()
            shown["created"] = f"{when:%Y-%m-%d %H:%M:%S}"
        shown["seconds"] = number(self.values["seconds"])
        if isinstance(self.values["metric"], int | float):
            _, title = _MAIN[self.run.stage]
            percent = title == "δ"
            shown["metric"] = (
                f"{title} {number(self.values['metric'], 100 if percent else 1)}" + " %" * percent
            )
        elif self.metrics.get("diverged"):
            shown["metric"] = "diverged"
        return [shown[field] for field in FIELDS]


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
        found = [entry for entry in found if _matches(_value(entry, name), wanted)]
    there = [entry for entry in found if _value(entry, key) is not None]
    there.sort(key=lambda entry: _order(_value(entry, key)), reverse=sort.startswith("-"))
    return there + [entry for entry in found if _value(entry, key) is None]


def runs_table(found: Sequence[Entry]) -> Table:
    """The runs for the terminal."""
    table = Table(box=None, header_style="bold", pad_edge=False)
    for field in FIELDS:
        heading = "time [s]" if field == "seconds" else field
        table.add_column(escape(heading), justify="right" if field == "seconds" else "left", no_wrap=True)
    for entry in found:
        table.add_row(*map(escape, entry.texts()))
    return table


def difference_table(first: Run, second: Run) -> Table:
    """What differs between two runs: configuration, origin, and result with its relative change.

    Raises:
        SchemaError: one of them is broken.
    """
    for run in (first, second):
        if run.fault:
            raise SchemaError(f"{run.path} is broken ({run.fault}); run `nsf {run.stage}` again")
    one, two = Entry(first), Entry(second)
    table = Table(box=None, header_style="bold", pad_edge=False)
    for heading in ("", "key", first.id, second.id, "change"):
        table.add_column(heading, overflow="fold")
    parts = {
        "configuration": (one.settings, two.settings),
        "origin": tuple(_flat({k: e.manifest.get(k) for k in _ORIGIN}) for e in (one, two)),
        "result": tuple(
            {"status": e.run.status, "seconds": e.values["seconds"]} | e.metrics for e in (one, two)
        ),
    }
    for part, (left, right) in parts.items():
        keys = [key for key in (left | right) if left.get(key) != right.get(key)]
        for index, key in enumerate(keys):
            a, b = left.get(key), right.get(key)
            table.add_row("" if index else part, key, escape(text(a)), escape(text(b)), _change(a, b))
        if not keys:
            table.add_row(part, "the same", "", "", "")
    return table


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
    known[run] = inherited | _flat(run.config)
    return known[run]


def _check_key(key: str, found: Sequence[Entry]) -> None:
    if not found or key in FIELDS or any(key in entry.values or key in entry.settings for entry in found):
        return
    known = dict.fromkeys([*FIELDS, *(k for entry in found for k in (*entry.values, *entry.settings))])
    near = difflib.get_close_matches(key, known, n=3, cutoff=0.5)
    hint = f"did you mean {' or '.join(near)}?" if near else f"choose {', '.join(FIELDS)}, a metric or a key"
    raise ConfigError(f"no run has {key!r}; {hint}")


def _value(entry: Entry, key: str):
    return entry.values[key] if key in entry.values else entry.settings.get(key)


def _matches(value, wanted: str) -> bool:
    several = value if isinstance(value, tuple) else (value,)
    return any(fnmatchcase(text(one), pattern) for one in several for pattern in wanted.split(","))


def _order(value) -> tuple[int, float, str]:
    """Numbers by size, before text in the order of the alphabet."""
    if isinstance(value, int | float):
        return (0, float(value), "")
    return (1, 0.0, str(value))


def _flat(value, prefix: str = "") -> dict[str, Any]:
    """A tree as dotted keys."""
    if not isinstance(value, dict) or not value:
        return {prefix: value} if prefix else {}
    return {
        key: leaf
        for name, child in value.items()
        for key, leaf in _flat(child, f"{prefix}.{name}" if prefix else str(name)).items()
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


def _change(a, b) -> str:
    kinds = (int, float)
    if isinstance(a, bool) or not isinstance(a, kinds) or not isinstance(b, kinds) or a == 0:
        return ""
    return f"{100 * (b - a) / abs(a):+.3g} %"
