"""Charts of errors: at each program, of each variant, and over what a report varies."""

import re
import textwrap

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from nsf.data.case import PROGRAM
from nsf.results.charts.drawing import ERROR, finite, lines, row_names, whole_mean
from nsf.results.charts.view import Figures, View, chart
from nsf.results.columns import COLUMNS, RIVALS, SEEDS, column
from nsf.results.formats import file_name
from nsf.results.style import (
    INK,
    LOST,
    MUTED,
    PAPER,
    REDUCED,
    band,
    error_scale,
    figure,
    legend,
    panels,
    plain_ticks,
)
from nsf.results.table import variants

_LOG = ("sampler.size", "training_runs", "trainer.steps", "particles", "train_seconds", "sampler.cells")


@chart(
    "Displacement error at each held-out program, the mean over seeds (dots), and their median (line): of "
    "every model, and below the line of rivals that need none. A dot at the right edge is a lost run; "
    "(beyond) are programs that led beyond what was taught."
)
def programs(view: View) -> Figures:
    """Displacement error of every program by model, a panel a body; of scenes that programs force."""
    forced = view.frame[view.frame["case"].str.contains(f"{PROGRAM}=")]
    if forced.empty:
        return {}
    groups = list(forced.groupby("body", sort=False))
    most = max(part["variant"].nunique() for _, part in groups) + len(RIVALS)
    fig, drawn = panels(len(groups), max(3.0, 0.6 + 0.3 * most), 2)
    for panel, (body, part) in zip(drawn, groups, strict=True):
        rows = {
            name: _of_programs(one["displacement_error"], one)
            for name, one in part.groupby("variant", sort=False)
        }
        models = len(rows)
        rows |= {COLUMNS[name].title: _of_programs(part[name], part) for name in RIVALS}
        every = np.concatenate(list(rows.values()))
        error_scale(panel, every, "x")
        for y, errors in enumerate(rows.values()):
            color = REDUCED if y < models else MUTED
            _dots(panel, y, errors, color)
        panel.axhline(models - 0.5, color=MUTED, lw=0.8)
        panel.set_yticks(range(len(rows)), ["\n".join(textwrap.wrap(name, 32)) for name in rows])
        panel.set(title=body, xlabel=ERROR, ylim=(len(rows) - 0.45, -0.55))
        panel.tick_params(axis="y", length=0)
    return {"programs": fig}


def _of_programs(errors: pd.Series, part: pd.DataFrame) -> np.ndarray:
    """Errors [%] of each case, means over seeds; ∞ where one is lost, none where nothing was measured."""
    return 100 * errors.groupby(part["case"]).agg(whole_mean).dropna().to_numpy()


def _dots(panel, y: int, errors: np.ndarray, color: str) -> None:
    """Errors [%] as dots in a row, with their median; those beyond the axis at its end."""
    if not len(errors):  # an empty line that is not clipped has a box without end
        return
    edge = panel.get_xlim()[1]
    panel.plot(
        np.minimum(errors, edge), np.full(len(errors), y), "o", ms=4.5, mfc="white", mec=color, clip_on=False
    )
    if (middle := np.median(errors)) <= edge:
        panel.plot([middle] * 2, [y - 0.34, y + 0.34], color=color, lw=2.4)


@chart(
    "Mean δ of each variant (bar or diamond), and δ of each case or, where there are several, seed (dots)."
)
def delta(view: View) -> Figures:
    """δ of every variant, and the paper's."""
    averages = view.averages
    groups = view.frame.groupby(["body", "variant"], sort=False)["delta"]
    fig = figure(1.5 + 0.34 * len(averages), 8.4)
    panel, at = fig.subplots(), np.arange(len(averages))
    every = []
    for i, row in averages.iterrows():
        values = 100 * finite(_of_each(view.frame.loc[groups.groups[(row["body"], row["variant"])]]))
        every += [*values, 100 * row["delta"], 100 * row["paper_delta"]]
        panel.plot(values, np.full(len(values), i), "o", ms=4.5, mfc="white", mec=INK, mew=0.9)
    panel.plot(100 * averages["paper_delta"], at, "|", ms=13, mew=2.6, color=PAPER, label="the paper")
    average = 100 * finite(averages["delta"])
    for y in np.flatnonzero(~(average <= LOST)):
        place = {"transform": panel.get_yaxis_transform(), "ha": "left", "va": "center"}
        panel.text(1.01, float(y), "diverged" if np.isnan(average[y]) else "lost", **place)
    average[average > LOST] = np.nan
    error_scale(panel, every, "x")
    if panel.get_xscale() == "log":  # a bar's length means nothing there
        panel.plot(average, at, "D", ms=7, color=REDUCED, label="mean", zorder=1.9)
    else:
        panel.barh(at, average, height=0.58, color=REDUCED, alpha=0.75, label="mean")
    panel.set_yticks(at, row_names(averages))
    panel.set(ylim=(len(averages) - 0.45, -0.55), xlabel=COLUMNS["delta"].heading)
    panel.tick_params(axis="y", length=0)
    legend(fig)
    return {"delta": fig}


@chart(
    "Mean δ (line), and from the smallest to the largest over cases and seeds (band). A line has a gap where "
    "a run diverged. A cross is what the paper prints; dashed are interpolated latents, which take no step."
)
def delta_over(view: View) -> Figures:
    """δ over each number that the report varies: a panel a scene, a line for each setting of the others."""
    varied = _varied(view.frame)
    return {f"delta-over-{file_name(re.sub(r'[._]', '-', key))}": _over(view.frame, key) for key in varied}


def _varied(frame: pd.DataFrame) -> list[str]:
    """The numbers that vary within a scene."""
    names = [name for name in frame if "." in name and name not in SEEDS] + ["training_runs", "r"]
    if "trainer.steps" in frame and frame["train_seconds"].notna().all():
        names = ["train_seconds", *(name for name in names if name != "trainer.steps")]
    names = [name for name in names if name.endswith(".particles") or not name.startswith("scene.")]
    return [
        name
        for name in names
        if name in frame
        and pd.api.types.is_numeric_dtype(frame[name])
        and (frame.groupby("scene")[name].nunique() > 1).any()
    ]


def _over(frame: pd.DataFrame, key: str) -> Figure:
    """δ over one number."""
    frame = frame[frame[key].notna()]
    bound = [name for name in frame if key.endswith(".particles") and name.startswith("scene.")]
    hidden = [key, *bound, *(["trainer.steps"] if key == "train_seconds" else [])]
    if key == "train_seconds":
        frame = frame.assign(train_seconds=frame.groupby(["body", "variant"])[key].transform("mean"))
    by = "scene" if bound else "body"
    frame = frame.assign(line=variants(frame.assign(body=frame[by]), hidden))
    styles = lines(frame["line"])
    groups = list(frame.groupby(by, sort=False))
    fig, drawn = panels(len(groups), 2.8, sharex=True)
    for panel, (body, part) in zip(drawn, groups, strict=True):
        every = []
        for name, line in part.groupby("line", sort=False):
            values = 100 * line.groupby(key)["delta"].agg(["min", "max", whole_mean])
            low, high, middle = (finite(values[of]) for of in ("min", "max", "whole_mean"))
            style = styles[name] | {"marker": "o", "ms": 4}
            band(panel, values.index, middle, low, high, **style)
            every += [*low, *high]
        if key == "training_runs":
            free = 100 * part.groupby(key)["delta_interpolated"].agg(whole_mean)
            panel.plot(free.index, free, "s--", ms=4, color=MUTED, label="interpolate")
        papers = part[[key, "paper_delta"]].dropna().drop_duplicates()
        if len(papers):
            panel.plot(papers[key], 100 * papers["paper_delta"], "X", ms=8, color=PAPER, label="the paper")
        error_scale(panel, [*every, *(100 * papers["paper_delta"])])
        panel.set(title=body, ylabel=COLUMNS["delta"].heading)
        panel.tick_params(labelbottom=True)
    fig.supxlabel(column(key).heading)
    if frame[key].min() > 0 and (key in _LOG or frame[key].max() > 10 * frame[key].min()):
        drawn[0].set_xscale("log")
        plain_ticks(drawn[0].xaxis, "{:,.10g}".format)
    legend(fig)
    return fig


def _of_each(part: pd.DataFrame) -> pd.Series:
    """δ of each seed, the mean over cases, where there are several; else of each case."""
    seeds = [part[name].fillna(-1) for name in SEEDS if name in part and part[name].nunique() > 1]
    return part["delta"].groupby(seeds).agg(whole_mean) if seeds else part["delta"]
