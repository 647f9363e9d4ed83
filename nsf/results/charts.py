"""The charts of a report: each is one function of its table.

A chart takes a `View` and gives figures by the name of their file, or none where the table holds nothing of
its kind. A new one is one function below `@chart(caption)`; pages, `nsf reports` and `plots` of an
experiment's yaml know it by its name from then on.
"""

import functools
import math
import re
import textwrap
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from nsf.data.case import PROGRAM
from nsf.results.columns import COLUMNS, RIVALS, SEEDS, axis, column, number
from nsf.results.formats import file_name
from nsf.results.style import (
    FULL,
    INK,
    LOST,
    MUTED,
    PALETTE,
    PAPER,
    REDUCED,
    STAGE_TITLES,
    band,
    error_scale,
    figure,
    legend,
    line_style,
    panels,
    plain_ticks,
    stage_colors,
    styled,
)
from nsf.results.table import means, parameter, variants

Figures = Mapping[str, Figure]
_LINE = 60  # letters of a label beside a chart, in a line
_MARKERS = "o^vDsP"
_LINES = ((0, (6, 2)), (0, (2, 1.5)), (0, (1, 3)))
_COARSE = {"color": FULL, "marker": "s", "mfc": "white", "mew": 1.6}
_COARSER = "full order on a coarser grid"
_DASHED = (0, (2, 1.6))
_SPAN = "time for one full-order Δt [ms]"
_OVER_TIME = (
    *("delta", "displacement_error", "stress_error"),
    *("linear_momentum_error", "angular_momentum_error"),
)
_LOG = ("sampler.size", "training_runs", "trainer.steps", "particles", "train_seconds", "sampler.cells")
ERROR = COLUMNS["displacement_error"].heading


@dataclass(frozen=True)
class View:
    """A report as charts see it.

    Attributes:
        frame: its rows, as `nsf.results.table.labelled` gives them.
        series: errors and latent coordinates, a row a frame, with `body`, `variant` and `case`; None where
            the runs are not there.
        stages: time of a step by stage [ms], of each variant by "body · variant", and of the full-order
            step under "full order".
        trained: the training cases of each scene, a mapping from parameter to value.
        logarithmic: names of parameters whose design is logarithmic.
    """

    frame: pd.DataFrame
    series: pd.DataFrame | None = None
    stages: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    trained: Mapping[str, Sequence[Mapping[str, float]]] = field(default_factory=dict)
    logarithmic: frozenset[str] = frozenset()

    @cached_property
    def averages(self) -> pd.DataFrame:
        """A row a body and variant, with means over cases and seeds."""
        return means(self.frame)


@dataclass(frozen=True)
class Chart:
    """A chart: the function that draws it, and the caption of its figures."""

    draw: Callable[[View], Figures]
    caption: str


CHARTS: dict[str, Chart] = {}
"""Every chart by its name, in the order in which a page shows them."""


def chart(caption: str) -> Callable[[Callable[[View], Figures]], Callable[[View], Figures]]:
    """Register a function of a `View` as a chart under its own name; it draws in the style of all charts."""

    def register(draw: Callable[[View], Figures]) -> Callable[[View], Figures]:
        @functools.wraps(draw)
        def drawn(view: View) -> Figures:
            with styled():
                return draw(view)

        CHARTS[draw.__name__] = Chart(drawn, caption)
        return drawn

    return register


# -- errors of programs ---------------------------------------------------------------------------------


@chart(
    "Displacement error at each held-out program, the mean over seeds (dots), and their median (line): of "
    "every model, and below the line of rivals that need none. A dot at the right edge is a run that is lost."
)
def programs(view: View) -> Figures:
    """Displacement error of every program by model, a panel a body; of scenes that programs force."""
    forced = view.frame[view.frame["case"].str.contains(f"{PROGRAM}=")]
    if forced.empty:
        return {}
    groups = list(forced.groupby("body", sort=False))
    most = max(part["variant"].nunique() for _, part in groups) + len(RIVALS)
    fig, drawn = panels(len(groups), max(3.0, 0.6 + 0.27 * most), 2)
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
        panel.set_yticks(range(len(rows)), ["\n".join(textwrap.wrap(name, 30)) for name in rows])
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


# -- errors of the variants -----------------------------------------------------------------------------


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
        values = 100 * _finite(_of_each(view.frame.loc[groups.groups[(row["body"], row["variant"])]]))
        every += [*values, 100 * row["delta"], 100 * row["paper_delta"]]
        panel.plot(values, np.full(len(values), i), "o", ms=4.5, mfc="white", mec=INK, mew=0.9)
    panel.plot(100 * averages["paper_delta"], at, "|", ms=13, mew=2.6, color=PAPER, label="the paper")
    average = 100 * _finite(averages["delta"])
    for y in np.flatnonzero(~(average <= LOST)):
        place = {"transform": panel.get_yaxis_transform(), "ha": "left", "va": "center"}
        panel.text(1.01, float(y), "diverged" if np.isnan(average[y]) else "lost", **place)
    average[average > LOST] = np.nan
    error_scale(panel, every, "x")
    if panel.get_xscale() == "log":  # a bar's length means nothing there
        panel.plot(average, at, "D", ms=7, color=REDUCED, label="mean", zorder=1.9)
    else:
        panel.barh(at, average, height=0.58, color=REDUCED, alpha=0.75, label="mean")
    panel.set_yticks(at, _names(averages))
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
    names = list(dict.fromkeys(frame["line"]))
    groups = list(frame.groupby(by, sort=False))
    fig, drawn = panels(len(groups), 2.8, sharex=True)
    for panel, (body, part) in zip(drawn, groups, strict=True):
        every = []
        for name, line in part.groupby("line", sort=False):
            values = 100 * line.groupby(key)["delta"].agg(["min", "max", whole_mean])
            low, high, middle = (_finite(values[of]) for of in ("min", "max", "whole_mean"))
            style = line_style(names.index(name)) | {"marker": "o", "ms": 4, "label": name}
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


# -- costs ----------------------------------------------------------------------------------------------


@chart(
    "Displacement error over the time for one full-order Δt (a solver of longer steps takes fewer): the "
    "full-order solver is the vertical line, squares are coarser grids; horizontal lines take no step."
)
def error_over_cost(view: View) -> Figures:
    """Error of every model over the time of its step, where it was timed."""
    timed = view.averages[view.averages["step_ms"].notna()]
    if timed.empty:
        return {}
    styles = _styles(dict.fromkeys(timed["variant"]))
    groups = list(timed.groupby("body", sort=False))
    fig, drawn = panels(len(groups), 3.1, 3)
    for panel, (body, part) in zip(drawn, groups, strict=True):
        for row in part.to_dict("records"):
            style = {"label": row["variant"], **styles[row["variant"]]}
            _dot(panel, row["step_ms"] / _multiple(view, row), row["displacement_error"], **style)
        panel.axvline(part["step_ms_full"].median(), color=FULL, lw=1.6, label="full order")
        coarse = [part[name].median() for name in ("step_ms_coarse", "displacement_coarse")]
        _dot(panel, *coarse, label=_COARSER, **_COARSE)
        everywhere = view.averages[view.averages["body"] == body]
        for name, ls in zip(RIVALS[:3], _LINES, strict=True):
            if math.isfinite(error := everywhere[name].min()):
                panel.axhline(100 * error, color=MUTED, ls=ls, lw=1.2, label=COLUMNS[name].title)
        panel.set(xscale="log", yscale="log", title=body, xlabel=_SPAN, ylabel=ERROR)
        panel.margins(0.12)
        panel.set_ylim(top=min(panel.get_ylim()[1], LOST))
        panel.grid()
        for line in (panel.xaxis, panel.yaxis):
            plain_ticks(line)
    legend(fig)
    return {"error-over-cost": fig}


def _multiple(view: View, row: Mapping) -> float:
    """A model's Δt over the full-order one's."""
    name = "deploy.dt_multiplier"
    if name not in view.frame:
        return 1.0
    rows = view.frame[(view.frame["body"] == row["body"]) & (view.frame["variant"] == row["variant"])]
    return rows[name].fillna(1.0).iloc[0]


@chart("Speedup over the full-order model, of mean times (line: 1×), and peak memory of the steps of both.")
def speedup_and_memory(view: View) -> Figures:
    """Speedup [×] and memory [MiB] of every variant that was timed."""
    averages = view.averages[view.averages["speedup_step"].notna()].reset_index(drop=True)
    if averages.empty:
        return {}
    fig = figure(1.7 + 0.5 * len(averages))
    speed, memory = fig.subplots(1, 2, sharey=True)
    colors = {"speedup_step": "#009E73", "speedup_total": "#CC79A7", "speedup_decoded": "#E69F00"}
    _numbers(speed, averages, colors)
    _numbers(memory, averages, {"memory_full_mib": FULL, "memory_mib": REDUCED})
    speed.axvline(1, color=INK, lw=1)
    speed.set_xlabel("speedup over full order [×]")
    memory.set_xlabel("peak memory [MiB]")
    speed.set_yticks(np.arange(len(averages)), _names(averages))
    speed.set_ylim(len(averages) - 0.4, -0.6)
    legend(fig)
    return {"speedup-memory": fig}


@chart(
    "Time for one full-order Δt over the particles of the scene; each size has a Δt and a field of its own."
)
def step_over_particles(view: View) -> Figures:
    """Time of a step over the number of particles, where a scene has several."""
    averages = view.averages.dropna(subset="step_ms")
    averages = averages[averages.groupby("scene")["particles"].transform("nunique") > 1]
    if averages.empty:
        return {}
    groups = list(averages.groupby("scene", sort=False))
    styles = _styles(dict.fromkeys(averages["model_name"]))
    fig, drawn = panels(len(groups), 3.4, 2)
    for panel, (scene, part) in zip(drawn, groups, strict=True):
        full = part.groupby("particles")[["step_ms_full", "step_ms_coarse"]].median()
        panel.plot(full.index, full["step_ms_full"], "o-", ms=5, color=FULL, label="full order")
        panel.plot(full.index, full["step_ms_coarse"], ms=5, **_COARSE, ls="--", label=_COARSER)
        for name, rows in part.groupby("model_name", sort=False):
            times = rows.groupby("particles")["step_ms"].median()
            panel.plot(times.index, times, ms=5, label=name, **styles[name])
        panel.set(xscale="log", yscale="log", title=scene, ylabel=_SPAN)
        panel.set_xlabel(COLUMNS["particles"].heading)
        panel.set_xticks(full.index, [f"{size:,.0f}" for size in full.index])
        panel.minorticks_off()
        panel.grid()
        plain_ticks(panel.yaxis)
    legend(fig)
    return {"step-over-particles": fig}


@chart("Where the time of a step goes, stage by stage; measuring takes a little time too.")
def runtime(view: View) -> Figures:
    """Time of each stage of a step above that of the full-order step, a figure a body and model."""
    figures = {}
    for stem, series in _best_series(view):
        stages = view.stages.get(f"{series['body'].iloc[0]} · {series['variant'].iloc[0]}", {})
        if len(stages) > 1:
            steps = {
                f"{series['model_name'].iloc[0]} step": stages,
                "full-order step": view.stages["full order"],
            }
            titles = {f"{name}, {number(sum(of.values()))} ms": pd.Series(of) for name, of in steps.items()}
            figures[f"{stem}runtime"] = bars(titles)
    return figures


def bars(times: Mapping[str, pd.Series], floors: Mapping[str, pd.Series] | None = None) -> Figure:
    """Times [ms] of stages or passes, a bar each, with a floor as a mark.

    Args:
        times: by the title of a panel, a series by stage; panels have one order of the stages.
        floors: by title, lower bounds of some of them.
    """
    names = list(dict.fromkeys(name for of in times.values() for name in of.index))
    color = dict(zip(names, stage_colors(names), strict=True))
    with styled():
        fig = figure(1.5 + 0.42 * len(names))
        row = fig.subplots(1, len(times), sharey=True, squeeze=False)[0]
        for panel, (title, of) in zip(row, times.items(), strict=True):
            at = [names.index(name) for name in of.index]
            style = {"height": 0.6, "color": [color[name] for name in of.index], "label": "time"}
            drawn = panel.barh(at, of, **style)
            panel.bar_label(drawn, [number(ms) for ms in of], padding=4, fontsize=8.5, color=INK)
            if floors and title in floors:
                panel.plot(floors[title], at, "|", ms=17, mew=2.4, color=INK, label="floor")
            panel.set(title=title, xlabel="time [ms]", xlim=(0, 1.2 * of.max()))
            panel.set_yticks(range(len(names)), [STAGE_TITLES.get(n, n.replace("_", " ")) for n in names])
            panel.set_ylim(len(names) - 0.5, -0.5)
            panel.grid(axis="x")
            panel.tick_params(axis="y", length=0)
        legend(fig)
    return fig


# -- over time ------------------------------------------------------------------------------------------


@chart(
    "Errors of held-out cases frame by frame, of the best variant of each model. Dashed: δ of the full-order "
    "frames encoded and decoded, which the fields alone explain. The displacement error divides by the "
    "distance moved, so it starts high."
)
def error_over_time(view: View) -> Figures:
    """δ, displacement, stress and momentum errors [%] over time [s], a figure a body and model."""
    figures = {}
    for stem, series in _best_series(view):
        shown = [name for name in _OVER_TIME if name in series and series[name].notna().any()]
        fig, drawn = panels(len(shown), 2.9, 3)
        for panel, name in zip(drawn, shown, strict=True):
            _frames(panel, series, name, "reconstruction_delta" if name == "delta" else "", scale=100)
            panel.set(xlabel="time t [s]", ylabel=axis(column(name).title, "%"))
            error_scale(panel, 100 * series[name])
            panel.set_xlim(-0.01 * series["t"].max(), 1.01 * series["t"].max())
            panel.xaxis.set_major_locator(MaxNLocator(5))
        legend(fig, axis(*parameter(series["case"].iloc[0])))
        figures[f"{stem}error-over-time"] = fig
    return figures


@chart("The latent path of a run (solid) and of the full-order frames through the encoder (dashed).")
def latent(view: View) -> Figures:
    """Latent coordinates over time, a figure a body and model."""
    figures = {}
    for stem, series in _best_series(view):
        r = sum(name.startswith("xhat_") and series[name].notna().any() for name in series)
        if not r:
            continue
        fig, drawn = panels(r, 2.1, 3, sharex=True)
        for k, panel in enumerate(drawn, start=1):
            _frames(panel, series, f"xhat_{k}", f"encoded_{k}", lw=2.4)
            panel.set(ylabel=f"x̂{chr(0x2080 + k) if k < 10 else k} [–]", xlabel="t [s]")
            panel.locator_params(nbins=4)
            panel.grid()
        legend(fig, axis(*parameter(series["case"].iloc[0])))
        figures[f"{stem}latent"] = fig
    return figures


def _frames(panel, series: pd.DataFrame, name: str, dashed: str, scale: float = 1.0, **width) -> None:
    """A column over time, a line a case, and another one dashed, where the series has it."""
    for i, (case, part) in enumerate(series.groupby("case", sort=False)):
        style, text = line_style(i), case.partition("=")[2] if case.count("=") == 1 else case
        panel.plot(part["t"], _finite(scale * part[name]), label=text, **style)
        if dashed in part:
            faint = {"color": style["color"], "ls": _DASHED, "alpha": 0.5, **width}
            panel.plot(part["t"], scale * part[dashed], **faint)


def best(frame: pd.DataFrame) -> Iterator[tuple[str, str, str]]:
    """File stem, body and variant of the best variant of each body and model: all would drown a page.

    One whose steps another model took stands last.
    """
    averages = means(frame)
    averages["rank"] = averages["delta"].where(averages["fallback_share"].fillna(0) < 1, math.inf)
    chosen = averages.sort_values("rank", kind="stable").groupby(["body", "model_name"], sort=False).head(1)
    chosen = averages.loc[sorted(chosen.index)]
    for row in chosen.to_dict("records"):
        several = (chosen["body"].nunique() > 1, (chosen["body"] == row["body"]).sum() > 1)
        parts = [row["body"] if several[0] else "", row["model_name"] if several[1] else ""]
        stem = "".join(f"{file_name(re.sub(r'[ ,=()·]+', '-', part)).strip('-')}-" for part in parts if part)
        yield stem, row["body"], row["variant"]


def _best_series(view: View) -> Iterator[tuple[str, pd.DataFrame]]:
    """The series of the best variant of each body and model, of the first seed, by file stem."""
    if view.series is None:
        return
    for stem, body, variant in best(view.frame):
        rows = view.series[(view.series["body"] == body) & (view.series["variant"] == variant)]
        if not rows.empty:
            yield stem, rows[rows["run"] == rows["run"].iloc[0]]


# -- shared ---------------------------------------------------------------------------------------------


def _styles(names: Sequence[str]) -> dict[str, dict]:
    """Colour and marker of each name."""
    return {
        name: {"color": PALETTE[i % len(PALETTE)], "marker": _MARKERS[i // len(PALETTE) % len(_MARKERS)]}
        for i, name in enumerate(names)
    }


def _dot(panel, span: float, error: float, **style) -> None:
    """A mark at a time [ms] and an error, a fraction, where both are on logarithmic axes."""
    if math.isfinite(span) and math.isfinite(error) and span > 0 and error > 0:
        panel.plot(span, 100 * error, ms=7, ls="", **style)


def _numbers(panel, averages: pd.DataFrame, columns: Mapping[str, str]) -> None:
    """Dots of each variant, a colour a column, each with its number beside it, on a logarithmic axis."""
    panel.set_xscale("log")
    for k, (name, color) in enumerate(columns.items()):
        at = np.arange(len(averages)) + 0.72 * ((k + 0.5) / len(columns) - 0.5)
        panel.plot(averages[name], at, "o", ms=6, color=color, label=column(name).title)
        for x, y in zip(averages[name], at, strict=True):
            if math.isfinite(x):
                place = {"textcoords": "offset points", "va": "center", "fontsize": 8.5}
                panel.annotate(number(x), (x, y), (6, 0), **place)
    low, high = panel.get_xlim()
    panel.set_xlim(low, high * (high / low) ** 0.16)  # room for the last numbers
    plain_ticks(panel.xaxis, "{:,g}".format)
    panel.grid(axis="x")
    panel.tick_params(axis="y", length=0)


def _names(averages: pd.DataFrame) -> list[str]:
    """Names of the rows of `means`, in lines; the body alone, or the variant alone, where that tells them."""
    bodies, kinds = averages["body"].nunique(), averages["variant"].nunique()
    names = averages["body"] + (" · " + averages["variant"] if kinds > 1 else "")
    names = averages["variant"] if bodies == 1 and kinds > 1 else names
    return ["\n".join(textwrap.wrap(name, _LINE, break_on_hyphens=False)) for name in names]


def _of_each(part: pd.DataFrame) -> pd.Series:
    """δ of each seed, the mean over cases, where there are several; else of each case."""
    seeds = [part[name].fillna(-1) for name in SEEDS if name in part and part[name].nunique() > 1]
    return part["delta"].groupby(seeds).agg(whole_mean) if seeds else part["delta"]


def whole_mean(values: pd.Series) -> float:
    """The mean; missing where one value is."""
    return values.mean(skipna=False)


def _finite(values) -> np.ndarray:
    """Values with gaps where they are not finite: a run that diverged has no line from there on."""
    values = np.array(values, float)
    values[~np.isfinite(values)] = np.nan
    return values
