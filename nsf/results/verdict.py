"""The short answer of a report of one model: its error, its bound, its rivals and its speed."""

import math
from pathlib import Path

import pandas as pd
from rich.console import RenderableType
from rich.table import Table

from nsf.results import table
from nsf.results.averages import console_table, means
from nsf.results.columns import COLUMNS, RIVALS, number
from nsf.results.formats import terminal

#: Of a body that never moves the error is 100 %.
_RIVALS = [name for name in RIVALS if name != "displacement_static"]
_LIGHTS = {
    "green": "green (at most half of trust.limit, 10 % by default)",
    "red": "red (above trust.limit, or beyond what was taught)",
}


def verdict(frame: pd.DataFrame) -> list[tuple[str, str]]:
    """Names of answers and the answers; nothing where a table compares several models, or scenes.

    Args:
        frame: as `nsf.results.table.labelled` gives it.
    """
    averages = means(frame)
    if len(averages) != 1:
        return []
    row = averages.iloc[0]
    answers = {
        "error": _error(row, frame),
        "error bound": _bound(frame),
        "rivals": _rivals(row),
        "speed": _speed(row),
    }
    return [(name, answer) for name, answer in answers.items() if answer]


def on_terminal(path: Path) -> RenderableType:
    """The answers of a report's `results.csv`, or its table where it has several rows."""
    answers = verdict(table.labelled(table.read(path)))
    if not answers:
        return console_table(path)
    grid = Table(box=None, show_header=False, pad_edge=False)
    for row in answers:
        grid.add_row(*map(terminal, row))
    return grid


def _error(row: pd.Series, frame: pd.DataFrame) -> str:
    if row["diverged"]:
        return f"{row['diverged']} of {row['cases']} runs diverged"
    mean, worst = (number(row[name], 100) for name in ("displacement_error", "displacement_worst"))
    cases = f"{row['cases']} {' and '.join(frame['split'].unique())} runs"
    stress = "" if math.isnan(row["stress_error"]) else f"; stress {number(row['stress_error'], 100)} % off"
    return f"{mean} % of the displacement, the mean of {cases}; largest {worst} %{stress}"


def _bound(frame: pd.DataFrame) -> str:
    bounds = frame["error_bound"]
    if bounds.isna().any():
        return ""
    ends = " to ".join(dict.fromkeys(number(end, 100) for end in (bounds.min(), bounds.max())))
    held = int((frame["displacement_error"] <= bounds).sum())
    counts = frame["flag"].value_counts().items()
    flags = [f"{count} {_LIGHTS.get(flag, flag)}" for flag, count in counts if flag]
    lights = "; ".join(["", *flags])
    return f"{ends} %, to hold in 90 % of runs, held by {held} of {len(frame)} runs{lights}"


def _rivals(row: pd.Series) -> str:
    errors = {COLUMNS[name].title: row[name] for name in _RIVALS if not math.isnan(row[name])}
    listed = ", ".join(f"{name} {number(error, 100)} %" for name, error in errors.items())
    nearer = [name for name, error in errors.items() if error < row["displacement_error"]]
    return f"{listed}; nearer: {' and '.join(nearer) or 'none'}" if listed else ""


def _speed(row: pd.Series) -> str:
    if math.isnan(row["speedup_total"]):
        return ""
    decoded = f"; {number(row['speedup_decoded'])} with every frame decoded"
    times = f"{number(row['speedup_total'])} times as fast as full order"
    return times + (decoded if row["speedup_decoded"] > 0 else "")
