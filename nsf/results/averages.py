"""Means of the table of results over cases and seeds, for pages and for a terminal; nothing here draws."""

from pathlib import Path

import numpy as np
import pandas as pd
import rich.console

from nsf.results import table
from nsf.results.columns import COLUMNS, SEEDS, number
from nsf.results.formats import terminal, terminal_table

_CONSOLE = (
    *("variant", "case", "cases", "paper_delta", "delta", "displacement_error", "displacement_interpolated"),
    *("stress_error", "speedup_step", "speedup_decoded", "fallback_share"),
)
SAID_ONCE = (
    *("model", "model_name", "teacher", "stress", "affine", "field", "r", "material", "particles"),
    *("precision", "device"),
)
_DRAWS = 10_000  # of seeds and cases, for the interval of a mean


def averaged(frame: pd.DataFrame) -> pd.DataFrame:
    """Means of a labelled frame; each case by itself where the paper prints single ones.

    Of several seeds stands the interval of 95 % of means of seeds and cases drawn with replacement.
    """
    single = frame.groupby(["body", "variant"])["paper_delta"].nunique(dropna=False).max() > 1
    by = ["body", "variant", *(["case"] if single else [])]
    averages = table.means(frame, by)
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
    means = values[rows[:, :, None], columns[:, None, :]].mean((1, 2))
    return " to ".join(number(end, 100) for end in np.quantile(means, (0.025, 0.975)))


def console_table(path: Path) -> rich.console.Group:
    """The means of a report's `results.csv` for a terminal; what never changes is said once, below."""
    frame = table.labelled(table.read(path))
    averages = averaged(frame)
    shown = [
        name for name in _CONSOLE if name in averages and (_is_measured(name) or averages[name].nunique() > 1)
    ]
    once = ", ".join(f"{title} {text}" for title, text in table.constants(frame, SAID_ONCE).items())
    return rich.console.Group(terminal_table(table.rows_of(averages, ["body", *shown])), terminal(once))


def _is_measured(name: str) -> bool:
    return name.startswith("speedup") or (name in COLUMNS and COLUMNS[name].measured)
