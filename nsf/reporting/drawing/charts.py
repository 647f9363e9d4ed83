"""Charts of errors, latent coordinates and costs: data in, figure out, units on every axis."""

import math
import re
import textwrap
from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from nsf.reporting.text.columns import axis, number, parameter_text
from nsf.results.scales import LOST, error_scale, plain_ticks, set_apart
from nsf.results.style import (
    FULL,
    INK,
    MUTED,
    PAPER,
    REDUCED,
    STAGE_TITLES,
    figure,
    legend_above,
    line_style,
    stage_colors,
    styled,
)

OVER_TIME = {
    "delta": "relative deformation error δ",
    "displacement_error": "displacement error",
    "stress_error": "stress error",
    "linear_momentum_error": "linear momentum error",
    "angular_momentum_error": "angular momentum error",
}
_ACROSS = 4  # panels of scenes in a row
_LINE = 60  # letters of a label beside a chart, in a line


def error_over_time(
    series: pd.DataFrame, columns=("delta", "displacement_error"), name: str = "parameter", unit: str = ""
) -> Figure:
    """Errors [%] of every frame over simulated time [s], one line a parameter value.

    Args:
        series: rows of `series.csv`; errors are fractions.
        columns: the errors shown, one panel each.
        name, unit: of the problem parameter.
    """
    with styled():
        fig = figure(4.1)
        panels = fig.subplots(1, len(columns), squeeze=False)[0]
        for panel, column in zip(panels, columns, strict=True):
            for i, (value, part) in enumerate(_by_parameter(series)):
                panel.plot(
                    part["t"],
                    _finite(100 * part[column]),
                    label=parameter_text(value, "", unit),
                    **line_style(i),
                )
            panel.set(xlabel="time t [s]", ylabel=f"{OVER_TIME.get(column, column)} [%]")
            error_scale(panel, 100 * series[column])
            # The whole time span, where runs diverged early too.
            panel.set_xlim(-0.01 * series["t"].max(), 1.01 * series["t"].max())
            panel.xaxis.set_major_locator(MaxNLocator(5))  # three panels have no room for more
        _legend_above(fig, panels[0], axis(name, unit))
    return fig


def latent_trajectories(series: pd.DataFrame, name: str = "parameter", unit: str = "") -> Figure:
    """The latent path of each parameter value: the first two coordinates in a plane, and every one over time.

    Solid: the reduced model's xhat. Dashed: the full-order frames through the encoder. Coordinates are
    dimensionless.
    """
    r = sum(column.startswith("xhat_") for column in series)
    columns = max(1, math.ceil(r / 2))
    with styled():
        fig = figure(5.0)
        grid = fig.add_gridspec(2, columns + 2, width_ratios=[1.25, 1.25] + [1] * columns)
        plane = fig.add_subplot(grid[:, :2])
        over_time = [fig.add_subplot(grid[i // columns, 2 + i % columns]) for i in range(r)]
        second = "xhat_2" if r > 1 else "t"
        for i, (value, part) in enumerate(_by_parameter(series)):
            color = line_style(i)["color"]
            solid, dashed = (
                {"color": color, "alpha": 0.9},
                {"color": color, "ls": (0, (2, 1.6)), "lw": 2.4, "alpha": 0.45},
            )
            plane.plot(part[_encoded("xhat_1")], part[_encoded(second)], **dashed)
            plane.plot(part["xhat_1"], part[second], label=parameter_text(value, "", unit), **solid)
            plane.plot(part["xhat_1"].iloc[:1], part[second].iloc[:1], "o", ms=5, color=color)
            for k, panel in enumerate(over_time, start=1):
                panel.plot(part["t"], part[f"encoded_{k}"], **dashed)
                panel.plot(part["t"], part[f"xhat_{k}"], **solid)
        plane.set(xlabel="x̂₁ [–]", ylabel="x̂₂ [–]" if r > 1 else "time t [s]")
        plane.grid()
        for k, panel in enumerate(over_time, start=1):
            panel.set_title(f"x̂{_subscript(k)} [–]", fontweight="normal", pad=3)
            panel.tick_params(labelsize=8)
            panel.locator_params(nbins=4)
            panel.grid()
            if k > r - columns:
                panel.set_xlabel("t [s]")
            else:
                panel.tick_params(labelbottom=False)
        plane.plot([], [], color=INK, label="reduced")
        plane.plot([], [], color=INK, ls=(0, (2, 1.6)), lw=2.4, alpha=0.45, label="encoded full-order")
        _legend_above(fig, plane, axis(name, unit))
    return fig


def reconstruction_and_rollout(series: pd.DataFrame, name: str = "parameter", unit: str = "") -> Figure:
    """How much of each parameter value's error the manifold alone explains.

    Root mean square over frames of δ [%]: the full-order frames encoded and decoded (open), and the
    reduced model's rollout (filled). The distance between the two is what the dynamics add.
    """
    groups = _by_parameter(series)
    with styled():
        fig = figure(1.5 + 0.34 * max(len(groups), 3), 7.2)
        panel = fig.subplots()
        low, high = (
            _finite([100 * _rms(part[column]) for _, part in groups])
            for column in ("reconstruction_delta", "delta")
        )
        at = np.arange(len(groups))
        panel.hlines(at, low, high, color=REDUCED, lw=3, alpha=0.3)
        panel.plot(
            low, at, "o", ms=8, mfc="white", mec=REDUCED, mew=1.6, label="reconstruction: decode(encode(x))"
        )
        panel.plot(high, at, "o", ms=8, color=REDUCED, label="rollout: reduced dynamics")
        panel.set_yticks(at, [f"{parameter_text(value)}, {part['split'].iloc[0]}" for value, part in groups])
        panel.set(ylabel=axis(name, unit), xlabel="RMS over frames of δ [%]", ylim=(len(groups) - 0.5, -0.5))
        error_scale(panel, np.concatenate([low, high]), "x")
        _legend_above(fig, panel, None)
        set_apart(fig)
    return fig


def delta_per_variant(variants: list[dict], dots: str = "one parameter value") -> Figure:
    """Mean δ [%] of each variant, what it is the mean of as dots, and the paper's figure.

    Args:
        variants: per variant `label`, `mean` and `values` (fractions), and `paper` (fraction or None).
        dots: what each of the values is of.
    """
    with styled():
        fig = figure(1.5 + 0.46 * len(variants), 8.4)
        panel = fig.subplots()
        at = np.arange(len(variants))
        for i, v in enumerate(variants):
            values = 100 * _finite(v["values"])
            label = dots if i == 0 else None
            panel.plot(
                values, np.full(len(values), i), "o", ms=4.5, mfc="white", mec=INK, mew=0.9, label=label
            )
        papers = [(i, 100 * v["paper"]) for i, v in enumerate(variants) if v["paper"] is not None]
        if papers:
            y, x = np.array(papers).T
            panel.plot(x, y, "|", ms=15, mew=2.6, color=PAPER, label="paper")
        every = _finite([x for v in variants for x in (*v["values"], v["mean"], v["paper"] or v["mean"])])
        shown = every[~np.isnan(every)]
        logarithmic = len(shown) > 0 and shown.min() > 0 and shown.max() > 30 * shown.min()
        if logarithmic:
            panel.set_xscale("log")
            plain_ticks(panel.xaxis)
        average = 100 * _finite([v["mean"] for v in variants])
        for y in np.flatnonzero(~(average <= LOST)):
            told = "diverged" if np.isnan(average[y]) else f"off by more than {LOST:,.0f} %"
            beside = {"transform": panel.get_yaxis_transform(), "ha": "left", "va": "center"}
            panel.text(1.01, float(y), told, **beside)
        average[average > LOST] = np.nan
        if logarithmic:  # a bar's length means nothing on a logarithmic axis
            panel.plot(average, at, "D", ms=8, color=REDUCED, label="mean", zorder=1.9)
        else:
            panel.barh(at, average, height=0.58, color=REDUCED, alpha=0.75, label="mean")
        panel.set_yticks(at, _wrapped(variants))
        panel.set_ylim(len(variants) - 0.45, -0.55)
        panel.set_xlabel("relative deformation error δ [%]")
        panel.set_xlim(right=min(panel.get_xlim()[1], LOST))
        panel.grid(axis="x")
        panel.tick_params(axis="y", length=0)
        _legend_above(fig, panel, None)
        set_apart(fig)
    return fig


def delta_over(
    panels: dict[str, dict[str, dict[float, list[float]]]],
    x: str,
    papers: dict[str, list[tuple[float, float]]],
) -> Figure:
    """δ [%] over a number: the mean as a line, from the smallest to the largest value as a band.

    Args:
        panels: by scene, a panel each: by the name of a line, the values of δ (fractions) at each x.
        x: label of that axis.
        papers: by scene, each x and δ (a fraction) that the paper prints.
    """
    names = list(dict.fromkeys(name for lines in panels.values() for name in lines))
    names.sort(key=lambda name: "operators" not in name)  # which are blue in every chart
    known = {x for lines in panels.values() for line in lines.values() for x in line}
    with styled():
        rows = math.ceil(len(panels) / _ACROSS)
        fig = figure(0.9 + 2.8 * rows)
        grid = fig.subplots(rows, min(_ACROSS, len(panels)), squeeze=False, sharex=True).ravel()
        drawn = grid[: len(panels)]
        for panel in grid[len(panels) :]:
            panel.axis("off")
        for panel, (scene, lines) in zip(drawn, panels.items(), strict=True):
            every = []
            for name, line in lines.items():
                at = sorted(line)
                values = [100 * np.asarray(line[x], float) for x in at]
                style = line_style(names.index(name))
                low, high = (_finite([end(v) for v in values]) for end in (np.min, np.max))
                panel.fill_between(at, low, high, color=style["color"], alpha=0.18, linewidth=0)
                if len(at) == 1:  # a band without width
                    panel.vlines(at, low, high, color=style["color"], alpha=0.36, linewidth=6)
                panel.plot(at, _finite([v.mean() for v in values]), marker="o", ms=4, label=name, **style)
                every += [*low, *high]
            for value, delta in papers.get(scene, ()):
                panel.plot(value, 100 * delta, "X", ms=8, color=PAPER, label="the paper")
                every.append(100 * delta)
                known.add(value)
            panel.set(title=scene, ylabel="δ [%]")
            panel.tick_params(labelbottom=True)
            error_scale(panel, every)
        fig.supxlabel(x)
        if max(known) > 10 * min(known):
            drawn[0].set_xscale("log")
            plain_ticks(drawn[0].xaxis, lambda value: f"{value:,.10g}")
        told = {line.get_label(): line for panel in drawn for line in panel.lines}
        told |= {name: told.pop(name) for name in ("the paper",) if name in told}  # last
        if len(told) > 1:
            legend_above(fig, told.values(), told.keys(), 6)
    return fig


def _by_parameter(series: pd.DataFrame) -> list[tuple]:
    return list(series.groupby("parameter", sort=True))


def _encoded(column: str) -> str:
    return column.replace("xhat_", "encoded_")


def _finite(values) -> np.ndarray:
    """Values with gaps where they are not finite: a run that diverged has no line from there on."""
    values = np.array(values, float)
    values[~np.isfinite(values)] = np.nan
    return values


def _rms(values) -> float:
    """Over the frames that have a value; ∞ once one of them is."""
    values = np.asarray(values, float)
    return float(np.sqrt(np.nanmean(values**2)))


def _legend_above(fig: Figure, panel, title: str | None) -> None:
    handles, labels = panel.get_legend_handles_labels()
    order = sorted(range(len(labels)), key=lambda i: labels[i] != "mean")
    handles, labels = [handles[i] for i in order], [labels[i] for i in order]
    legend_above(fig, handles, labels, 6, title=title, columnspacing=1.4, alignment="left")


def _subscript(k: int) -> str:
    return "".join(chr(0x2080 + int(digit)) for digit in str(k))


def runtime_breakdown(breakdown: dict[str, dict[str, float]]) -> Figure:
    """Where one step's time [ms] goes, for the reduced and for the full-order solver.

    Args:
        breakdown: {"reduced": {stage: ms}, "full_order": {stage: ms}}. Each ring is one whole step; the
            sum of its stages stands in the middle.
    """
    titles = {"reduced": "reduced step", "full_order": "full-order step"}
    return rings([{title: breakdown.get(solver, {}) for solver, title in titles.items()}])


def rings(rows: Sequence[Mapping[str, Mapping[str, float]]]) -> Figure:
    """Where the time [ms] of a step goes, a ring each with its sum in the middle.

    Args:
        rows: of two rings, {title: {stage: ms}}; without stages it says that nothing was measured.
    """
    with styled():
        fig = figure(2.75 * len(rows))
        panels = fig.subplots(len(rows), 4, width_ratios=[1, 0.78, 1, 0.78], squeeze=False)
        for across, row in zip(panels, rows, strict=True):
            for ring, key, (title, stages) in zip(across[::2], across[1::2], row.items(), strict=True):
                _ring(ring, key, stages, title)
    return fig


def _wrapped(variants: list[dict]) -> list[str]:
    """Labels in lines that leave room for the chart beside them; lists break between their entries."""
    spaced = (re.sub(r",\s*(?=[^\[\]]*\])", ", ", v["label"]) for v in variants)
    # "r 6" and "|S| 50" stay on one line: what follows their space is not broken off.
    joined = (re.sub(r"(\br|\|S\|) (?=\d)", "\\1\N{NO-BREAK SPACE}", label) for label in spaced)
    return ["\n".join(textwrap.wrap(label, _LINE, break_on_hyphens=False)) for label in joined]


def speedup_and_memory(variants: list[dict]) -> Figure:
    """Speedup [×] and peak memory [MiB] of each variant, both logarithmic: engines differ a thousandfold.

    Args:
        variants: per variant `label, speedup_step, speedup_total, speedup_shown, memory_full_mib,
            memory_reduced_mib`; what was not measured is NaN and is said so.
    """
    with styled():
        fig = figure(1.7 + 0.56 * len(variants))
        left, right = fig.subplots(1, 2, sharey=True)
        speedups = {
            "speedup_step": ("one step", "#009E73"),
            "speedup_total": ("run", "#CC79A7"),
            "speedup_shown": ("run, frames decoded", "#E69F00"),
        }
        memory = {"memory_full_mib": ("full-order", FULL), "memory_reduced_mib": ("reduced", REDUCED)}
        _dots(left, variants, speedups)
        _dots(right, variants, memory)
        left.axvline(1, color=INK, lw=1)
        left.set_xlim(left=min(left.get_xlim()[0], 0.8))
        left.set_xlabel("speedup over full-order [×]")
        right.set_xlabel("peak memory [MiB]")
        left.set_yticks(np.arange(len(variants)), _wrapped(variants))
        left.set_ylim(len(variants) - 0.4, -0.6)
        set_apart(fig)
    return fig


def _ring(pie, key, stages: Mapping[str, float], title: str) -> None:
    pie.set_title(title)
    key.axis("off")
    if not stages:
        pie.axis("off")
        pie.text(0.5, 0.5, "not measured", transform=pie.transAxes, ha="center", color=MUTED)
        return
    total = sum(stages.values())
    decimals = max(0, 2 - math.floor(math.log10(total)))
    wedges, *_ = pie.pie(
        list(stages.values()), colors=stage_colors(stages), startangle=90, counterclock=False,
        wedgeprops={"width": 0.36, "edgecolor": "white", "linewidth": 1.5},
    )  # fmt: skip
    pie.text(0, 0, f"{number(total)} ms,\nall stages", ha="center", va="center", fontsize=11)
    labels = [
        f"{STAGE_TITLES.get(stage, stage.replace('_', ' '))}  {ms:.{decimals}f} ms, {100 * ms / total:.0f} %"
        for stage, ms in stages.items()
    ]
    key.legend(
        wedges, labels, loc="center left", bbox_to_anchor=(-0.18, 0.5), handlelength=1, labelspacing=0.7
    )


def _dots(panel, variants: list[dict], columns: Mapping[str, tuple[str, str]]) -> None:
    """Dots of each variant, by column with their label and colour, each with its number beside it."""
    panel.set_xscale("log")
    for k, (column, (label, color)) in enumerate(columns.items()):
        values = np.array([v.get(column, math.nan) for v in variants], float)
        at = np.arange(len(variants)) + 0.72 * ((k + 0.5) / len(columns) - 0.5)
        panel.plot(values, at, "o", ms=6, color=color, label=label)
        for x, y in zip(values, at, strict=True):
            if np.isfinite(x):
                panel.annotate(
                    number(x),
                    (x, y),
                    (6, 0),
                    textcoords="offset points",
                    va="center",
                    fontsize=8.5,
                    color=INK,
                )
            else:
                panel.text(
                    0.02, y, "not measured", transform=panel.get_yaxis_transform(), va="center", fontsize=8.5
                )
    low, high = panel.get_xlim()
    panel.set_xlim(low, high * (high / low) ** 0.16)  # room for the last numbers
    plain_ticks(panel.xaxis, "{:,g}".format)
    panel.grid(axis="x")
    panel.tick_params(axis="y", length=0)
    panel.legend(
        loc="lower left", bbox_to_anchor=(-0.02, 1.0), ncols=len(columns), columnspacing=1.2, handlelength=1.2
    )
