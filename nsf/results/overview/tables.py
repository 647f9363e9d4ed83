"""Runs for the terminal: listed, one in full, and what differs between two."""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any

from rich.markup import escape
from rich.table import Table

from nsf.errors import SchemaError
from nsf.results.columns import number
from nsf.runs import Run
from nsf.runs.columns import cell, differing, scaled, title_of, unit_of
from nsf.runs.listing import FIELDS, MAIN, ORIGIN, Entry, flat, text, value_of
from nsf.runs.pruning import bytes_text, size_of

#: Characters that a terminal, however narrow, leaves of a field.
_WIDTHS = {"stage": 8, "id": 12}


@dataclass(frozen=True)
class Cell:
    """A value of a listed run: its text, and the value by which it sorts."""

    text: str
    value: Any


def headings(keys: Sequence[str]) -> list[str]:
    """Of the fields of a run, and of keys."""
    return ["time [s]" if field == "seconds" else field for field in FIELDS] + list(map(title_of, keys))


def cells(entry: Entry, keys: Sequence[str]) -> list[Cell]:
    """A run below `headings`."""
    shown = {field: text(entry.values[field]) for field in FIELDS}
    if entry.values["created"]:
        shown["created"] = _when(entry.values["created"])
    shown["seconds"] = number(entry.values["seconds"])
    if isinstance(entry.values["metric"], int | float):
        _, title = MAIN[entry.run.stage]
        percent = title == "δ"
        shown["metric"] = f"{title} {number(entry.values['metric'], 100 if percent else 1)}" + " %" * percent
    elif entry.metrics.get("diverged"):
        shown["metric"] = "diverged"
    fields = [Cell(shown[field], entry.values[field]) for field in FIELDS]
    return fields + [Cell(_setting(entry, key), value_of(entry, key)) for key in keys]


def runs_table(runs: Sequence[Entry], named: Sequence[str] = ()) -> Table:
    """Runs, with a column for each key in which they differ, or that was filtered or sorted by."""
    keys = differing(runs, named)
    table = Table(box=None, header_style="bold", pad_edge=False)
    for heading in headings(keys.keys):
        justify = "right" if heading == "time [s]" else "left"
        table.add_column(escape(heading), justify=justify, no_wrap=True, min_width=_WIDTHS.get(heading))
    for entry in runs:
        table.add_row(*(escape(cell.text) for cell in cells(entry, keys.keys)))
    if keys.more:
        table.caption = f"These differ as well, and have a column with KEY=*: {', '.join(keys.more)}"
        table.caption_justify = "left"
    return table


def run_table(run: Run, everything: Sequence[Run]) -> Table:
    """All that is known of one run.

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
    state = {"id": run.id, "folder": str(run.path), "status": run.status, "size": bytes_text(size_of(run))}
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


def _setting(entry: Entry, key: str) -> str:
    value = entry.values.get(key)
    return _rounded(key, value) if isinstance(value, float) else cell(entry, key)


def _with_unit(key: str, value: Any) -> str:
    return f"{_rounded(key, value)} {unit_of(key)}".strip()


def _when(created: str) -> str:
    return f"{datetime.fromisoformat(created).astimezone():%Y-%m-%d %H:%M}"


def _change(a: Any, b: Any) -> str:
    kinds = (int, float)
    if isinstance(a, bool) or not isinstance(a, kinds) or not isinstance(b, kinds) or a == 0:
        return ""
    return f"{100 * (b - a) / abs(a):+.3g} %"
