"""Charts of errors: at each program, of each variant, and over what a report varies."""

import re

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from nsf.data.case import PROGRAM
from nsf.results.charts.drawing import ERROR, base, finite, in_lines, mark, row_panels, styles, whole_mean
from nsf.results.charts.view import Figures, View, chart
from nsf.results.columns import COLUMNS, RIVALS, SEEDS, column
from nsf.results.formats import file_name
from nsf.results.style import (
    LOST,
    LOST_MARK,
    MUTED,
    PAPER,
    RIVAL_COLORS,
    band,
    error_scale,
    legend,
    model_color,
    panels,
    plain_ticks,
)
from nsf.results.table import BEYOND, variants

_FEW = 10  # δ at a number of which each is a dot, and no mean or range
_THE_PAPER = {"ms": 8, "color": PAPER, "zorder": 1.5, "label": "the paper"}  # below the dots
_LOG = ("sampler.size", "training_runs", "trainer.steps", "particles", "train_seconds", "sampler.cells")


@chart(
    "Displacement error at each held-out program, the mean over seeds (dots), and their median (line): of "
    "every model, and below the line of rivals that need none. A dot at the right edge is a lost run, "
    "a filled one, which is in no median, a program that led beyond what was taught."
)
def programs(view: View) -> Figures:
    """Displacement error of every program by model, a panel a body; of scenes that programs force."""
    forced = view.frame[view.frame["case"].str.contains(f"{PROGRAM}=")]
    if forced.empty:
        return {}
    forced = forced.assign(variant=forced["variant"].map(base), beyond=forced["variant"].str.endswith(BEYOND))
    groups = list(forced.groupby("body", sort=False))
    rivals = [[name for name in RIVALS if part[name].notna().any()] for _, part in groups]
    counts = [part["variant"].nunique() + len(of) for (_, part), of in zip(groups, rivals, strict=True)]
    fig, drawn = row_panels(counts, 0.32, 0.9)
    for panel, (body, part), of in zip(drawn, groups, rivals, strict=True):
        models = list(part.groupby("variant", sort=False))
        rows = {
            name: (_of_programs(one, "displacement_error"), model_color(one["model_name"].iloc[0]))
            for name, one in models
        }
        rows |= {COLUMNS[n].title: (_of_programs(part, n), RIVAL_COLORS[n]) for n in of}
        error_scale(panel, np.concatenate([errors for errors, _ in rows.values()]), "x")
        for y, (errors, color) in enumerate(rows.values()):
            _dots(panel, y, errors, color)
        for model in part["model_name"].unique():  # the rows' names may leave it out
            panel.plot([], [], "o", ms=4.5, mfc="white", mec=model_color(model), label=model)
        panel.axhline(len(models) - 0.5, color=MUTED, lw=0.8)
        panel.set_yticks(range(len(rows)), in_lines(rows, len(groups)))
        panel.set(title=body, xlabel=ERROR)
    drawn[0].plot([], [], "|", ms=12, mew=2.4, color=MUTED, label="median")
    if forced["beyond"].any():
        drawn[0].plot([], [], "o", ms=4.5, color=MUTED, label="filled: beyond what was taught")
    legend(fig)
    return {"programs": fig}


def _of_programs(part: pd.DataFrame, name: str) -> pd.Series:
    """Errors [%] by whether a case led beyond what was taught, means over seeds; ∞ where one is lost."""
    errors = 100 * part.groupby(["case", "beyond"])[name].agg(whole_mean).dropna()
    return errors.droplevel("case")


def _dots(panel, y: int, errors: pd.Series, color: str) -> None:
    """Errors [%] as dots in a row, with the median of those within; those beyond the axis at its end."""
    edge, within = panel.get_xlim()[1], errors[~errors.index.to_numpy(bool)]
    for of, face in ((within, "white"), (errors[errors.index.to_numpy(bool)], color)):
        if len(of):  # an empty line that is not clipped has a box without end
            style = {"ms": 4.5, "mfc": face, "mec": color, "clip_on": False}
            panel.plot(np.minimum(of, edge), np.full(len(of), y), "o", **style)
    if len(within) and (middle := np.median(within)) <= edge:
        panel.plot([middle] * 2, [y - 0.34, y + 0.34], color=color, lw=2.4)


@chart(
    "δ [%] of each case or, where there are several, seed (dots), a panel a scene and a colour a model, and "
    "their mean (line)."
)
def delta(view: View) -> Figures:
    """δ of every variant, and the paper's, a panel a body."""
    groups = list(view.averages.groupby("body", sort=False))
    fig, drawn = row_panels([len(averages) for _, averages in groups], 0.36, 0.8, sharex=True)
    every: list[float] = []
    for panel, (body, averages) in zip(drawn, groups, strict=True):
        every += _deltas(panel, view.frame[view.frame["body"] == body], averages.reset_index())
        panel.set_yticks(range(len(averages)), in_lines(averages["variant"], len(groups)))
        panel.set(title=body, xlabel=COLUMNS["delta"].heading)
        panel.tick_params(axis="x", labelbottom=True)
    for panel in drawn:
        error_scale(panel, every, "x")
        if panel.get_xscale() == "linear":
            panel.locator_params(axis="x", nbins=5)
    legend(fig)
    return {"delta": fig}


def _deltas(panel, frame: pd.DataFrame, averages: pd.DataFrame) -> list[float]:
    """δ [%] of the variants of a body, a row each; gives all that is drawn."""
    at, average = np.arange(len(averages)), 100 * finite(averages["delta"])
    every = [*average, *(100 * averages["paper_delta"])]
    for y, row in averages.iterrows():
        values = 100 * finite(_of_each(frame[frame["variant"] == row["variant"]]))
        color, name = model_color(row["model_name"]), row["model_name"]
        every += values.tolist()
        panel.plot(values, np.full(len(values), y), "o", ms=4.5, mfc="white", mec=color, mew=1.1)
        if average[y] <= LOST:
            panel.plot([average[y]] * 2, [y - 0.3, y + 0.3], color=color, lw=2.4, label=name)
        else:
            beside = {"transform": panel.get_yaxis_transform(), "clip_on": False}
            panel.plot(1.02, y, color=color, **LOST_MARK, **beside)
            place = {"textcoords": "offset points", "va": "center", "fontsize": 9, "color": MUTED}
            text, at_cross = "diverged" if np.isnan(average[y]) else "lost", panel.get_yaxis_transform()
            panel.annotate(text, (1.02, y), (6, 0), xycoords=at_cross, annotation_clip=False, **place)
    panel.plot(100 * averages["paper_delta"], at, "X", **_THE_PAPER)
    return every


@chart(
    "δ [%] of each case and seed (dots); of more than ten, their mean (line), and from the smallest to the "
    "largest (band). A line has a gap where a run diverged. A cross is what the paper prints; squares are "
    "interpolated latents, which take no step."
)
def delta_over(view: View) -> Figures:
    """δ over each number that the report varies: a panel a scene, a line for each setting of the others."""
    lines = {key: _lines(view.frame, key) for key in _varied(view.frame)}
    # A number that only varies along with other settings is no axis.
    axes = {key: of for key, of in lines.items() if (of.groupby(["body", "line"])[key].nunique() > 1).any()}
    return {f"delta-over-{file_name(re.sub(r'[._]', '-', key))}": _over(of, key) for key, of in axes.items()}


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


def _lines(frame: pd.DataFrame, key: str) -> pd.DataFrame:
    """The rows that have a number, with what else they vary as `line`; over sizes a scene is one body."""
    frame = frame[frame[key].notna()]
    bound = [name for name in frame if key.endswith(".particles") and name.startswith("scene.")]
    hidden = [key, *bound, *(["trainer.steps"] if key == "train_seconds" else [])]
    if key == "train_seconds":
        frame = frame.assign(train_seconds=frame.groupby(["body", "variant"])[key].transform("mean"))
    frame = frame.assign(body=frame["scene" if bound else "body"])
    return frame.assign(line=variants(frame, hidden))


def _over(frame: pd.DataFrame, key: str) -> Figure:
    """δ over one number, of rows with a `line`."""
    drawn_as = styles(frame, "line")
    groups = list(frame.groupby("body", sort=False))
    fig, drawn = panels(len(groups), 2.8, sharex=True)
    for panel, (body, part) in zip(drawn, groups, strict=True):
        every = []
        for name, of in part.groupby("line", sort=False):
            every += _dots_or_band(panel, of.groupby(key)["delta"], drawn_as[name])
        if key == "training_runs":
            free = 100 * part.groupby(key)["delta_interpolated"].agg(whole_mean)
            panel.plot(free.index, free, "s", ms=4, color=model_color("interpolate"), label="interpolate")
        papers = part[[key, "paper_delta"]].dropna().drop_duplicates()
        if len(papers):
            panel.plot(papers[key], 100 * papers["paper_delta"], "X", **_THE_PAPER)
        error_scale(panel, [*every, *(100 * papers["paper_delta"])])
        panel.set(title=body, ylabel=COLUMNS["delta"].heading)
        panel.tick_params(labelbottom=True)
    fig.supxlabel(column(key).heading)
    if len(steps := sorted(frame[key].unique())) <= _FEW:
        drawn[0].set_xticks(steps, [f"{one:,g}" for one in steps])
    if frame[key].min() > 0 and (key in _LOG or frame[key].max() > 10 * frame[key].min()):
        drawn[0].set_xscale("log")
        plain_ticks(drawn[0].xaxis, "{:,.10g}".format)
    legend(fig)
    return fig


def _dots_or_band(panel, groups, style: dict) -> list[float]:
    """δ [%] over a number: dots where each value of it has few, else their mean and range; gives the ends."""
    if groups.size().max() <= _FEW:
        values = 100 * groups.apply(lambda one: pd.Series(finite(one))).dropna()
        at = values.index.get_level_values(0)
        panel.plot(at, values, ls="", ms=4.5, mfc="white", **mark(style))
        return values.tolist()
    values = 100 * groups.agg(["min", "max", whole_mean])
    low, high, middle = (finite(values[of]) for of in ("min", "max", "whole_mean"))
    band(panel, values.index, middle, low, high, ms=4, **style)
    return [*low, *high]


def _of_each(part: pd.DataFrame) -> pd.Series:
    """δ of each seed, the mean over cases, where there are several; else of each case."""
    seeds = [part[name].fillna(-1) for name in SEEDS if name in part and part[name].nunique() > 1]
    return part["delta"].groupby(seeds).agg(whole_mean) if seeds else part["delta"]
