"""Means over the cases and seeds of a report, with their spread, as text, and what rivals do better."""

import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
import rich.console

from nsf.results.columns import (
    ABSENT,
    COLUMNS,
    MEASURED,
    RIVALS,
    SEEDS,
    column,
    is_empty,
    number,
    plus_minus,
)
from nsf.results.formats import Rows, TerminalTable, terminal
from nsf.results.table import labelled, read

_SCATTERED = ("delta", "displacement_error", "stress_error")
_TIMES = {
    "speedup_step": ("step_ms_full", "step_ms"),
    "speedup_total": ("total_ms_full", "total_ms"),
    "speedup_decoded": ("total_ms_full", "decoded_ms"),
}
SAID_ONCE = ("model_name", "stress", "affine", "field", "r", "material", "particles", "precision", "device")
"""Columns that are said above a table where all rows have one value."""
_CONSOLE = (
    *("variant", "case", "cases", "paper_delta", "displacement_error", "delta", "displacement_interpolated"),
    *("stress_error", "speedup_step", "speedup_decoded", "fallback_share"),
)
_TELLING = ("variant", "case", "cases", "paper_delta")  # shown where they vary
_KEPT = (
    *("scene", "material", "model", "model_name", "stress", "affine", "field", "r", "sample"),
    *("particles", "precision", "device"),
)
_DRAWS = 10_000  # of seeds and cases, for the interval of a mean
DEVIATION = ", deviation"
"""Ends the names of columns of `means` that have the deviation over seeds."""


def means(frame: pd.DataFrame, by: Sequence[str] = ("body", "variant")) -> pd.DataFrame:
    """A row a group of a labelled frame, with means over cases and seeds, and speedups of mean times.

    A value that is missing leaves its mean empty, and a run that diverged makes it ∞: neither is averaged
    around. Beside stand how many cases and runs that diverged there are, the largest displacement error,
    and of errors the deviation over seeds.
    """
    averaged = [*MEASURED, "delta_static", "delta_interpolated", "decoded_ms", "paper_delta"]
    rows = []
    for values, part in frame.groupby(list(by), sort=False, dropna=False):
        # pandas takes ten times as long for groups of a few rows
        numbers = zip(averaged, part[averaged].to_numpy(float).mean(0).tolist(), strict=True)
        row = dict(zip(by, values, strict=True)) | dict(numbers)
        row |= {"cases": len(part), "diverged": int(part["delta"].map(math.isinf).sum())}
        row |= {"displacement_worst": part["displacement_error"].max()}
        row |= {name: _only(part[name]) for name in (*_KEPT, "body") if name not in row}
        row |= part[["integration_share", "gamma"]].mean().to_dict()
        row |= speedups(row) | _deviations(part)
        rows.append(row)
    return pd.DataFrame(rows)


def averaged(frame: pd.DataFrame) -> pd.DataFrame:
    """Means of a labelled frame; each case by itself where the paper prints single ones."""
    return means(frame, _grouping(frame))


def with_intervals(averages: pd.DataFrame, frame: pd.DataFrame) -> pd.DataFrame:
    """The rows of `averaged` with the middle 95 % of means of seeds and cases drawn with replacement."""
    by = _grouping(frame)
    seeds = [name for name in SEEDS if name in frame and frame[name].nunique() > 1]
    if not seeds:
        return averages
    groups = frame.assign(**{name: frame[name].fillna(-1) for name in seeds}).groupby(by, sort=False)
    squares = [part.pivot_table("delta", seeds, "case", dropna=True).to_numpy() for _, part in groups]
    return averages.assign(delta_interval=[interval(values) for values in squares])


def interval(values: np.ndarray) -> str:
    """The middle 95 % of means of values [seeds, cases], both drawn anew, as text in per cent.

    Empty of one seed, and where a value is missing or a run diverged. The draws are the same at each call.

    Source: the percentile bootstrap, Efron and Tibshirani 1993, chapter 13, of rows and of columns.
    """
    if len(values) < 2 or not np.isfinite(values).all():
        return ""
    generator = np.random.default_rng(0)
    rows, columns = (generator.integers(n, size=(_DRAWS, n)) for n in values.shape)
    drawn = values[rows[:, :, None], columns[:, None, :]].mean((1, 2))
    return " to ".join(number(end, 100) for end in np.quantile(drawn, (0.025, 0.975)))


def speedups(times: Mapping[str, float]) -> dict[str, float]:
    """Speedups of mean times, NaN where they were not measured: a mean of ratios would hide slow runs."""
    pairs = {name: [times.get(time, math.nan) for time in of] for name, of in _TIMES.items()}
    return {n: full / model if full > 0 and model > 0 else math.nan for n, (full, model) in pairs.items()}


def where_rivals_win(averages: pd.DataFrame) -> str:
    """A sentence: on which bodies a rival is nearer than the best row of `means`, and by how much."""
    held = averages[averages["displacement_error"] > 0].dropna(subset=list(RIVALS), how="all")
    won = []
    for body, part in held.groupby("body", sort=False):
        best = part["displacement_error"].min()
        nearer = [f"{COLUMNS[n].title} ({_percent(part[n].min())})" for n in RIVALS if part[n].min() < best]
        if nearer:
            won.append(f"on {body} {' and '.join(nearer)} beside {_percent(best)}")
    if won:
        return f"A rival has a smaller displacement error than the best model: {'; '.join(won)}."
    return "No rival comes nearer than the best model." if len(held) else ""


def constants(frame: pd.DataFrame, names: Iterable[str]) -> dict[str, str]:
    """Of some columns those that have one value in all rows, as heading and text."""
    alike = [name for name in names if name in frame and frame[name].nunique(dropna=False) == 1]
    values = {name: frame[name].iloc[0] for name in alike}
    return {
        column(name).title: f"{column(name).cell(value)} {column(name).unit}".strip()
        for name, value in values.items()
        if not is_empty(value)
    }


def rows_of(frame: pd.DataFrame, names: Sequence[str]) -> Rows:
    """Columns of a frame as text with units in the headings, those with nothing in them left out."""
    shown = [name for name in names if name in frame and not frame[name].map(is_empty).all()]
    body = [[_cell(name, row) for name in shown] for row in frame.to_dict("records")]
    headings = [column(name).heading for name in shown]
    return Rows(headings, body, [not column(name).text for name in shown])


def console_table(path: Path) -> rich.console.Group:
    """The means of a report's `results.csv` for a terminal; what never changes is said once, below."""
    frame = labelled(read(path))
    averages = averaged(frame)
    same = {name for name in _TELLING if name in averages and averages[name].nunique() < 2}
    shown = [name for name in _CONSOLE if name in averages and name not in same]
    once = ", ".join(f"{title} {text}" for title, text in constants(frame, SAID_ONCE).items())
    return rich.console.Group(TerminalTable(rows_of(averages, ["body", *shown])), terminal(once))


def _deviations(part: pd.DataFrame) -> dict[str, float]:
    """Standard deviation over seeds of the mean over cases, NaN of one seed."""
    seeds = [part[name].fillna(-1) for name in SEEDS if name in part and part[name].nunique() > 1]
    if not seeds:
        return {f"{name}{DEVIATION}": math.nan for name in _SCATTERED}
    of_each = part[list(_SCATTERED)].groupby(seeds).agg(lambda values: values.mean(skipna=False))
    return {f"{name}{DEVIATION}": of_each[name].std(skipna=False) for name in _SCATTERED}


def _grouping(frame: pd.DataFrame) -> list[str]:
    single = frame.groupby(["body", "variant"])["paper_delta"].nunique(dropna=False).max() > 1
    return ["body", "variant", *(["case"] if single else [])]


def _only(values: pd.Series):
    """The one value of a group, or what stands for several."""
    return values.iloc[0] if len(set(map(str, values))) == 1 else None


def _percent(value: float) -> str:
    return f"{number(value, 100)} %" if math.isfinite(value) else "∞"


def _cell(name: str, row: Mapping) -> str:
    if f"{name}{DEVIATION}" in row:
        return plus_minus(row[name], row[f"{name}{DEVIATION}"], column(name).scale)
    return ABSENT if is_empty(row[name]) else column(name).cell(row[name])
