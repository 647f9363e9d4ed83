"""Charts of costs: the time of a step, speedup and memory."""

import math
from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from nsf.results.charts.drawing import ERROR, mark, row_names, styles
from nsf.results.charts.view import Figures, View, best_series, chart
from nsf.results.columns import COLUMNS, RIVALS, column, number
from nsf.results.style import (
    FULL,
    INK,
    LOST,
    MUTED,
    RIVAL_COLORS,
    STAGE_TITLES,
    figure,
    legend,
    model_color,
    panels,
    plain_ticks,
    stage_colors,
    styled,
)

_LINES = ((0, (6, 2)), (0, (2, 1.5)), (0, (1, 3)))
_COARSE = {"color": FULL, "marker": "s", "mfc": "white", "mew": 1.6}
_COARSER = "full order on a coarser grid"
_SPAN = "time for one full-order Δt [ms]"


@chart(
    "Displacement error over the time for one full-order Δt (a solver of longer steps takes fewer): the "
    "full-order solver is the vertical line, squares are coarser grids; horizontal lines take no step."
)
def error_over_cost(view: View) -> Figures:
    """Error of every model over the time of its step, where it was timed."""
    timed = view.averages[view.averages["step_ms"].notna()]
    if timed.empty:
        return {}
    drawn_as = styles(timed, "variant")
    groups = list(timed.groupby("body", sort=False))
    fig, drawn = panels(len(groups), 3.1, 3)
    for panel, (body, part) in zip(drawn, groups, strict=True):
        for row in part.to_dict("records"):
            time = row["step_ms"] / _multiple(view, row)
            _dot(panel, time, row["displacement_error"], **mark(drawn_as[row["variant"]]))
        panel.axvline(part["step_ms_full"].median(), color=FULL, lw=1.6, label="full order")
        coarse = [part[name].median() for name in ("step_ms_coarse", "displacement_coarse")]
        _dot(panel, *coarse, label=_COARSER, **_COARSE)
        everywhere = view.averages[view.averages["body"] == body]
        for name, ls in zip(RIVALS[:3], _LINES, strict=True):
            if math.isfinite(error := everywhere[name].min()):
                panel.axhline(100 * error, color=RIVAL_COLORS[name], ls=ls, lw=1.4, label=COLUMNS[name].title)
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
    fig = figure(1.9 + 0.5 * len(averages))
    speed, memory = fig.subplots(1, 2, sharey=True)
    colors = averages["model_name"].map(model_color)
    _numbers(speed, averages, dict.fromkeys(("speedup_step", "speedup_total", "speedup_decoded"), colors))
    _numbers(memory, averages, {"memory_full_mib": [FULL] * len(averages), "memory_mib": colors})
    speed.axvline(1, color=INK, lw=1, zorder=0.9)
    speed.set_xlabel("speedup over full order [×]")
    memory.set_xlabel("peak memory [MiB]")
    speed.set_yticks(np.arange(len(averages)), row_names(averages))
    speed.set_ylim(len(averages) - 0.4, -0.6)
    for name, color in dict(zip(averages["model_name"], colors, strict=True)).items():
        speed.plot([], [], "o", ms=6, color=color, label=name)
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
    drawn_as = styles(averages, "model_name")
    fig, drawn = panels(len(groups), 3.4, 2)
    for panel, (scene, part) in zip(drawn, groups, strict=True):
        full = part.groupby("particles")[["step_ms_full", "step_ms_coarse"]].median()
        panel.plot(full.index, full["step_ms_full"], "o-", ms=5, color=FULL, label="full order")
        panel.plot(full.index, full["step_ms_coarse"], ms=5, **_COARSE, ls="--", label=_COARSER)
        for name, rows in part.groupby("model_name", sort=False):
            times = rows.groupby("particles")["step_ms"].median()
            panel.plot(times.index, times, ms=5, **mark(drawn_as[name]))
        panel.set(xscale="log", yscale="log", title=scene, ylabel=_SPAN)
        panel.set_xlabel(COLUMNS["particles"].heading)
        panel.set_xticks(full.index, [f"{size:,.0f}" for size in full.index])
        panel.minorticks_off()
        panel.grid()
        plain_ticks(panel.yaxis)
    legend(fig)
    return {"step-over-particles": fig}


@chart(
    "Where the time of a step goes. The step is timed in whole runs, as in the table; its stages in other "
    "steps, with a wait for the device after each, so that their sum differs from the step."
)
def runtime(view: View) -> Figures:
    """Time of each stage of a step above that of the full-order step, a figure a body and model."""
    figures = {}
    for stem, series in best_series(view):
        stages = view.stages.get(f"{series['body'].iloc[0]} · {series['variant'].iloc[0]}", {})
        if len(stages) > 1:
            row = view.frame[view.frame["run"] == series["run"].iloc[0]].iloc[0]
            steps = (
                (row["model_name"], row["step_ms"], stages),
                ("full order", row["step_ms_full"], view.stages["full order"]),
            )
            titles = {
                f"{name}: step {number(ms)} ms, stages {number(sum(of.values()))} ms": pd.Series(of)
                for name, ms, of in steps
            }
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


def _dot(panel, span: float, error: float, **style) -> None:
    """A mark at a time [ms] and an error, a fraction, where both are on logarithmic axes."""
    if math.isfinite(span) and math.isfinite(error) and span > 0 and error > 0:
        panel.plot(span, 100 * error, ms=7, ls="", **style)


def _numbers(panel, averages: pd.DataFrame, columns: Mapping[str, Sequence[str]]) -> None:
    """Marks of each variant, a shape a column, in the colours of its models, on a logarithmic axis.

    Each has its number beside it: before it below 1, where a number behind it would lie on the line at 1.
    """
    panel.set_xscale("log")
    for k, (name, colors) in enumerate(columns.items()):
        at = np.arange(len(averages)) + 0.72 * ((k + 0.5) / len(columns) - 0.5)
        panel.plot([], [], ls="", marker="o^s"[k], ms=6, color=MUTED, label=column(name).title)
        for x, y, color in zip(averages[name], at, colors, strict=True):
            if math.isfinite(x):
                panel.plot(x, y, "o^s"[k], ms=6, color=color)
                place = {"textcoords": "offset points", "va": "center", "fontsize": 8.5}
                place |= {"ha": "right" if x < 1 else "left"}
                panel.annotate(number(x), (x, y), (-7 if x < 1 else 7, 0), **place)
    low, high = panel.get_xlim()
    room = (high / low) ** 0.2  # for the numbers at the ends
    panel.set_xlim(low / room if averages[list(columns)].min(axis=None) < 1 else low, high * room)
    plain_ticks(panel.xaxis, "{:,g}".format)
    panel.grid(axis="x")
    panel.tick_params(axis="y", length=0)
