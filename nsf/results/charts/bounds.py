"""Whether error bounds held: rows of results as a table, a row a body and model, and as a chart."""

import math

import numpy as np
import pandas as pd

from nsf.results.charts.drawing import ERROR
from nsf.results.charts.view import Figures, View, chart
from nsf.results.columns import COLUMNS
from nsf.results.style import INK, LOST, MUTED, legend, model_color, panels, plain_ticks

#: Displacement errors above which a run ought not to be green, and below which it ought not to be red.
BAD, GOOD = 0.2, 0.05
_MULTIPLES = np.geomspace(0.1, 4.0, 60)  # of the bound


def judged(frame: pd.DataFrame) -> pd.DataFrame:
    """The rows with a bound of the model that took the run from its beginning."""
    rows = frame.dropna(subset=["error_bound", "displacement_error"])
    return rows[rows["fallback_share"].fillna(0) == 0]


def promise(frame: pd.DataFrame) -> pd.DataFrame:
    """Coverage, sharpness and flags of error bounds, a row a body and model, and one of all.

    Args:
        frame: as `nsf.results.table.labelled` gives it.

    Returns:
        Columns `body`, `model_name`; `runs`; `holds`: share of runs within what was taught whose error is at
        most its bound; `sharpness`: median of bound over error; `rank`: Spearman's correlation of both;
        `missed`: of runs more than `BAD` off, the share that is green; `false_alarms`: of runs less than
        `GOOD` off, the share that is red.
    """
    rows = judged(frame)
    parts = [(*key, part) for key, part in rows.groupby(["body", "model_name"], sort=False)]
    if len(parts) > 1:
        parts.append(("all", "", rows))
    return pd.DataFrame([{"body": body, "model_name": name} | _of(part) for body, name, part in parts])


def _of(rows: pd.DataFrame) -> dict[str, float]:
    bound, error = rows["error_bound"], rows["displacement_error"]
    finite = np.isfinite(error) & np.isfinite(bound) & (error > 0)
    varies = error.nunique() > 1 and bound.nunique() > 1
    return {
        "runs": len(rows),
        "holds": _share((bound >= error)[_within(rows)]),
        "sharpness": (bound[finite] / error[finite]).median(),
        "rank": bound.rank().corr(error.rank()) if varies else np.nan,
        "missed": _share(rows["flag"].eq("green")[error > BAD]),
        "false_alarms": _share(rows["flag"].eq("red")[error < GOOD]),
    }


def _within(rows: pd.DataFrame) -> pd.Series:
    """Whether a row's case led nowhere beyond what was taught, so that a bound is promised."""
    return rows["beyond"].fillna(0) == 0


def _share(held: pd.Series) -> float:
    return float(held.mean()) if len(held) else np.nan


@chart(
    "Displacement error of each held-out run over its error bound, a panel a scene; below the line the bound "
    "holds. Last: share of runs whose error is at most a multiple of its bound; at 1 nine tenths ought to be."
)
def error_bounds(view: View) -> Figures:
    """Error over bound of every run, and how often multiples of the bound hold."""
    rows = judged(view.frame)
    rows = rows[np.isfinite(rows["error_bound"]) & (rows["error_bound"] > 0)]
    if rows["error_bound"].nunique() < 2:
        return {}
    groups = list(rows.groupby("body", sort=False))
    across = min(4, math.ceil((len(groups) + 1) / 2)) if len(groups) > 1 else 2
    fig, (*each, holds) = panels(len(groups) + 1, 7.6 / across, across)
    bounds, moved = rows["error_bound"], rows["displacement_error"]
    ends = [50 * min(bounds.min(), moved[moved > 0].min()), min(200 * bounds.max(), LOST)]
    for i, (panel, (body, part)) in enumerate(zip(each, groups, strict=True)):
        for name, of in part.groupby("model_name", sort=False):
            errors = np.clip(100 * of["displacement_error"], ends[0], ends[1])
            dots = {"ls": "", "marker": "o", "ms": 4, "mew": 0, "alpha": 0.7, "color": model_color(name)}
            panel.plot(np.minimum(100 * of["error_bound"], ends[1]), errors, label=name, **dots)
        panel.plot(ends, ends, color=INK, lw=1.0)
        panel.set(xscale="log", yscale="log", xlim=ends, ylim=ends, title=body)
        panel.set(xlabel=COLUMNS["error_bound"].heading, ylabel="" if i % across else ERROR)
        plain_ticks(panel.xaxis), plain_ticks(panel.yaxis)
    within = rows[_within(rows)]
    ratios = (within["displacement_error"] / within["error_bound"]).to_numpy()
    holds.plot(_MULTIPLES, [100 * np.mean(ratios <= multiple) for multiple in _MULTIPLES], color=INK)
    holds.axvline(1.0, color=MUTED, lw=0.8), holds.axhline(90.0, color=MUTED, lw=0.8)
    holds.set(xscale="log", xlabel="multiple of the bound [–]", ylabel="runs below it [%]", ylim=(0, 102))
    holds.set(title="all" if len(groups) > 1 else "")
    plain_ticks(holds.xaxis)
    legend(fig)
    return {"error-bounds": fig}
