"""Runs for the terminal: listed, one in full, and what differs between two."""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any

from rich.console import Group
from rich.markup import escape
from rich.table import Table

from nsf.errors import SchemaError
from nsf.results.columns import brief, number
from nsf.runs import Run
from nsf.runs.columns import CASE, TITLES, differing, scaled, setting, title_of, unit_of
from nsf.runs.listing import FIELDS, MAIN, ORIGIN, Entry, flat, text
from nsf.storage import bytes_text, size_of

_MOST = 6  # keys that have a column, beside those of `TITLES` and those that are named
_WIDEST = 28  # characters of a cell of a terminal
#: Metrics that have a column where there is room for it.
_RESULTS = ("delta", "stress_error", "validation_error", "error_bound", "step_ms_full", "step_ms")
_WIDE = 1000  # characters of a line that no terminal shows, where no text is cut
_GAP = 2  # characters between columns


@dataclass(frozen=True)
class Column:
    """A field of listed runs, a metric or a key.

    Attributes:
        key: by which runs are filtered and sorted.
        of: the metric that the field `metric` is in all runs, where it is one.
    """

    key: str
    of: str = ""

    @property
    def title(self) -> str:
        """Its heading, with the unit."""
        return "time [s]" if self.key == "seconds" else title_of(self.of or self.key)

    @property
    def numeric(self) -> bool:
        """Whether it is aligned to the right."""
        return self.key in ("seconds", *_RESULTS) or self.of != ""

    def value(self, entry: Entry) -> Any:
        """The value of a run, by which it sorts."""
        return setting(entry, self.key)

    def text(self, entry: Entry, widest: int | None = _WIDEST) -> str:
        """The value as shown, in at most so many characters if it is neither a number nor a case."""
        value = self.value(entry)
        if self.key == "created":
            return _when(value) if value else text(value)
        if self.key == "metric":
            return _metric(entry, self.of)
        shown = brief(_rounded(self.key, value) if self.key in entry.values else text(value))
        if widest is None or len(shown) <= widest or self.key == CASE or isinstance(value, int | float):
            return shown
        if isinstance(value, list | tuple):
            return f"{text(value[0])} … ({len(value)})"
        return f"{shown[: widest - 1]}…"


def columns(listed: Sequence[Entry], named: Sequence[str] = ()) -> tuple[list[Column], list[str]]:
    """The fields of runs, and keys in which they differ or that are named; further keys that differ."""
    mains = {MAIN[entry.run.stage][0] if entry.run.stage in MAIN else "" for entry in listed}
    keys = differing(listed, [key for key in named if mains != {key}])  # the metric is there already
    more = [key for key in keys if key not in TITLES and key not in named][_MOST:]
    results = [key for key in _RESULTS if key not in keys and any(key in e.metrics for e in listed)]
    of = mains.pop() if len(mains) == 1 else ""
    shown = [key for key in (*FIELDS, *keys, *results) if key not in more]
    return [Column(key, of if key == "metric" else "") for key in shown], more


def runs_table(listed: Sequence[Entry], named: Sequence[str] = (), width: int = 160) -> Group:
    """Runs with as many columns as a terminal of some width has room for; no cell is cut.

    Below stand the values that all runs share, cases of several parameters by their number, and the keys
    without a column.

    Args:
        listed: the runs.
        named: keys that were filtered or sorted by, which have a column.
        width: [characters].
    """
    every, more = columns(listed, named)
    widest = _WIDEST if width < _WIDE else None
    texts = {column: [column.text(entry, widest) for entry in listed] for column in every}
    keys = {key for key in named if key not in FIELDS}
    shared = [c for c in every if len(listed) > 1 and len(set(texts[c])) == 1 and c.key not in keys]
    legend = _numbered(texts)
    widths = {column: max(map(len, (column.title, *cells))) for column, cells in texts.items()}
    shown, room = [], width + _GAP
    for column in sorted((c for c in every if c not in shared), key=lambda c: _rank(c.key, named)):
        if widths[column] + _GAP <= room:
            shown.append(column)
            room -= widths[column] + _GAP
    table = Table(box=None, header_style="bold", pad_edge=False)
    for column in (chosen := [column for column in every if column in shown]):
        table.add_column(escape(column.title), justify="right" if column.numeric else "left", no_wrap=True)
    for row in zip(*(texts[column] for column in chosen), strict=True):
        table.add_row(*map(escape, row))
    said = [f"{column.title} {texts[column][0]}" for column in shared if texts[column][0] != text(None)]
    narrow = [column.title for column in every if column not in shown and column not in shared]
    lines = [
        f"The same in all: {', '.join(said)}" if said else "",
        *(f"case {number}: {case}" for case, number in legend.items()),
        f"Hidden for want of width: {', '.join(narrow)}" if narrow else "",
        f"These differ as well, and have a column with KEY=*: {', '.join(more)}" if more else "",
    ]
    return Group(table, *map(escape, filter(None, lines)))


def _numbered(texts: dict[Column, list[str]]) -> dict[str, str]:
    """Put numbers in place of cases of several values, which are long; gives the number of each."""
    cases = texts.get(Column(CASE), [])
    several = dict.fromkeys(case for case in cases if "=" in case or ";" in case)
    legend = {case: f"#{k}" for k, case in enumerate(several, 1)}
    if cases:
        texts[Column(CASE)] = [legend.get(case, case) for case in cases]
    return legend


def _rank(key: str, named: Sequence[str]) -> int:
    """The order in which columns take the room that there is."""
    order = ("id", "metric", "stage", "scene", "", "status", *_RESULTS, "seconds", "created")
    return 1 if key in named else order.index(key if key in order else "")


def _metric(entry: Entry, of: str) -> str:
    """The metric of a run, with its title and unit unless a heading has them."""
    value = entry.values["metric"]
    if not isinstance(value, int | float):
        return "diverged" if entry.metrics.get("diverged") else text(value)
    key, title = MAIN[entry.run.stage]
    return _rounded(key, value) if of else f"{title} {_with_unit(key, value)}"


def run_table(run: Run, everything: Sequence[Run]) -> Table:
    """All of one run.

    Args:
        run: whole, half-made or broken.
        everything: all runs, among them those that were made from it.
    """
    entry = Entry(run)
    table = Table(box=None, show_header=False, pad_edge=False)
    table.add_column(style="bold")
    table.add_column(no_wrap=True)
    table.add_column(overflow="fold")

    def part(title: str, rows: dict[str, str]) -> None:
        for at, (key, value) in enumerate(rows.items()):
            table.add_row("" if at else title, escape(key), escape(value))

    manifest = entry.manifest
    state = {
        "id": run.id,
        "folder": str(run.path),
        "status": run.status,
        "size": bytes_text(size_of(run.path)),
    }
    if value := entry.fault or manifest.get("error"):
        state["error"] = text(value)
    if manifest.get("created"):
        state["created"] = _when(manifest["created"])
    if entry.values["seconds"] is not None:
        state["time"] = f"{number(entry.values['seconds'])} s"
    part("run", state)
    origin = {key: manifest.get(key) for key in ORIGIN}
    part("origin", {key: text(value) for key, value in flat(origin).items() if value is not None})
    part("made from", {parent.id: parent.status for parent in run.parent_runs})
    part("needed by", {one.id: one.status for one in everything if run.id in one.parents})
    part("warnings", {str(at + 1): text(line) for at, line in enumerate(manifest.get("warnings", ()))})
    part("result", {key: _with_unit(key, value) for key, value in entry.metrics.items()})
    settings = {} if entry.fault or not manifest else flat(run.config)
    part("keys", {key: _with_unit(key, value) for key, value in settings.items()})
    part("files", {o["path"]: bytes_text(o["bytes"]) for o in manifest.get("outputs", ())})
    return table


def difference_table(first: Run, second: Run) -> Table:
    """Differences of two runs: configuration, origin, and result with its relative change.

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
        "origin": tuple(flat({k: e.manifest.get(k) for k in ORIGIN}) for e in (one, two)),
        "result": tuple(
            {"status": e.run.status, "seconds": e.values["seconds"]} | e.metrics for e in (one, two)
        ),
    }
    for part, (left, right) in parts.items():
        keys = [key for key in (left | right) if left.get(key) != right.get(key)]
        for index, key in enumerate(keys):
            a, b = left.get(key), right.get(key)
            shown = map(escape, (_heading(key), *_both(key, a, b)))
            table.add_row("" if index else part, *shown, _change(a, b))
        if not keys:
            table.add_row(part, "the same", "", "", "")
    return table


def _heading(key: str) -> str:
    unit = unit_of(key)
    return f"{key} [{unit}]" if unit else key


def _both(key: str, a: Any, b: Any) -> tuple[str, str]:
    """Two values as shown: to three digits, unless these are the same."""
    rounded = _rounded(key, a), _rounded(key, b)
    return rounded if rounded[0] != rounded[1] else (text(scaled(key, a)), text(scaled(key, b)))


def _rounded(key: str, value: Any) -> str:
    return number(scaled(key, value)) if isinstance(value, float) else text(scaled(key, value))


def _with_unit(key: str, value: Any) -> str:
    return f"{_rounded(key, value)} {unit_of(key)}".strip()


def _when(created: str) -> str:
    return f"{datetime.fromisoformat(created).astimezone():%Y-%m-%d %H:%M}"


def _change(a: Any, b: Any) -> str:
    kinds = (int, float)
    if isinstance(a, bool) or not isinstance(a, kinds) or not isinstance(b, kinds) or a == 0:
        return ""
    return f"{100 * (b - a) / abs(a):+.3g} %"
