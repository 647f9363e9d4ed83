"""Charts of errors: at each program, of each variant, and over what a report varies."""

import re
import textwrap
from collections.abc import Iterable

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from nsf.data.case import PROGRAM
from nsf.results.charts.drawing import ERROR, finite, lines, whole_mean
from nsf.results.charts.view import Figures, View, chart
from nsf.results.columns import COLUMNS, RIVALS, SEEDS, column
from nsf.results.formats import file_name
from nsf.results.style import (
    LOST,
    MUTED,
    PAPER,
    band,
    error_scale,
    legend,
    panels,
    plain_ticks,
)
from nsf.results.table import variants

_FEW = 10  # δ at a number of which each is a dot, and no mean or range
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
    groups, styles = list(forced.groupby("body", sort=False)), lines(forced["model_name"])
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
        model_of = part.drop_duplicates("variant").set_index("variant")["model_name"]
        for y, (name, errors) in enumerate(rows.items()):
            _dots(panel, y, errors, styles[model_of[name]]["color"] if name in model_of else MUTED)
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
    "δ [%] of each case or, where there are several, seed (dots), a panel a scene and a colour a model, and "
    "their mean (line)."
)
def delta(view: View) -> Figures:
    """δ of every variant, and the paper's, a panel a body."""
    styles = lines(view.averages["model_name"])
    groups = list(view.averages.groupby("body", sort=False))
    most = max(len(averages) for _, averages in groups)
    fig, drawn = panels(len(groups), 0.8 + 0.36 * most, 2, sharex=True)
    every: list[float] = []
    for panel, (body, averages) in zip(drawn, groups, strict=True):
        every += _deltas(panel, view.frame[view.frame["body"] == body], averages.reset_index(), styles)
        panel.set_yticks(
            range(len(averages)), _row_names(averages["variant"], 60 if len(groups) == 1 else 34)
        )
        panel.set(title=body, ylim=(most - 0.45, -0.55), xlabel=COLUMNS["delta"].heading)
        panel.tick_params(axis="y", length=0)
        panel.tick_params(axis="x", labelbottom=True)
    for panel in drawn:
        error_scale(panel, every, "x")
        if panel.get_xscale() == "linear":
            panel.locator_params(axis="x", nbins=5)
    legend(fig)
    return {"delta": fig}


def _row_names(names: Iterable[str], width: int) -> list[str]:
    """Names in lines; one of more letters than `width` has a line for each of its parts, or more."""

    def lines_of(name: str) -> list[str]:
        return [line for part in name.split(" · ") for line in textwrap.wrap(part, width)]

    return [name if len(name) <= width else "\n".join(lines_of(name)) for name in names]


def _deltas(panel, frame: pd.DataFrame, averages: pd.DataFrame, styles: dict[str, dict]) -> list[float]:
    """δ [%] of the variants of a body, a row each; gives all that is drawn."""
    at, average = np.arange(len(averages)), 100 * finite(averages["delta"])
    every = [*average, *(100 * averages["paper_delta"])]
    for y, row in averages.iterrows():
        values = 100 * finite(_of_each(frame[frame["variant"] == row["variant"]]))
        style = styles[row["model_name"]]
        every += values.tolist()
        panel.plot(values, np.full(len(values), y), "o", ms=4.5, mfc="white", mec=style["color"], mew=1.1)
        if average[y] <= LOST:
            place = {"color": style["color"], "label": style["label"], "lw": 2.4}
            panel.plot([average[y]] * 2, [y - 0.3, y + 0.3], **place)
        else:
            place = {"transform": panel.get_yaxis_transform(), "ha": "right", "fontsize": 9}
            panel.text(1.0, y - 0.18, "diverged" if np.isnan(average[y]) else "lost", **place)
    panel.plot(100 * averages["paper_delta"], at, "X", ms=8, color=PAPER, label="the paper")
    return every


@chart(
    "δ [%] of each case and seed (dots); of more than ten, their mean (line), and from the smallest to the "
    "largest (band). A line has a gap where a run diverged. A cross is what the paper prints; squares are "
    "interpolated latents, which take no step."
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
            every += _dots_or_band(panel, line.groupby(key)["delta"], styles[name])
        if key == "training_runs":
            free = 100 * part.groupby(key)["delta_interpolated"].agg(whole_mean)
            panel.plot(free.index, free, "s", ms=4, color=MUTED, label="interpolate")
        papers = part[[key, "paper_delta"]].dropna().drop_duplicates()
        if len(papers):
            panel.plot(papers[key], 100 * papers["paper_delta"], "X", ms=8, color=PAPER, label="the paper")
        error_scale(panel, [*every, *(100 * papers["paper_delta"])])
        panel.set(title=body, ylabel=COLUMNS["delta"].heading)
        panel.tick_params(labelbottom=True)
    fig.supxlabel(column(key).heading)
    if len(steps := sorted(frame[key].unique())) <= _FEW and all(float(one).is_integer() for one in steps):
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
        panel.plot(at, values, **style | {"linestyle": "", "marker": "o", "ms": 4.5, "mfc": "white"})
        return values.tolist()
    values = 100 * groups.agg(["min", "max", whole_mean])
    low, high, middle = (finite(values[of]) for of in ("min", "max", "whole_mean"))
    band(panel, values.index, middle, low, high, **style | {"marker": "o", "ms": 4})
    return [*low, *high]


def _of_each(part: pd.DataFrame) -> pd.Series:
    """δ of each seed, the mean over cases, where there are several; else of each case."""
    seeds = [part[name].fillna(-1) for name in SEEDS if name in part and part[name].nunique() > 1]
    return part["delta"].groupby(seeds).agg(whole_mean) if seeds else part["delta"]
