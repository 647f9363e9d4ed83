"""Charts of estimates: data in, figure out, units on every axis."""

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from nsf.results.columns import axis
from nsf.results.style import (
    FULL,
    INK,
    MUTED,
    PALETTE,
    figure,
    line_style,
    model_color,
    panels,
    styled,
)
from nsf.vectors import drawn

_BODY = 1500  # particles that show a body
_RUNS = {"fitted": ("run by recurrence", model_color("recurrence")), "full_order": ("full-order run", FULL)}
"""Columns of residuals, and the runs that they are of with their colours."""


def trials_chart(table: pd.DataFrame, units: Mapping[tuple[str, str], str]) -> Figure:
    """Estimate less truth, with its 90 % interval, over the truth: a panel a scene and parameter.

    Args:
        table: rows of results.csv, and `lower` and `upper` of their intervals.
        units: of the parameters, by scene and name.
    """
    groups = list(table.groupby(["scene", "parameter"], sort=False))
    with styled():
        fig, each = panels(len(groups), 3.4, 2)
        for panel, ((scene, name), part) in zip(each, groups, strict=True):
            for holds, trials in part.groupby("inside_90", sort=False):
                bars = [trials["estimate"] - trials["lower"], trials["upper"] - trials["estimate"]]
                panel.errorbar(
                    trials["truth"], trials["estimate"] - trials["truth"], bars, fmt="o", ms=3.5, lw=1.1,
                    color=PALETTE[1 - holds],
                    label=f"interval {'holds' if holds else 'misses'} the truth: {len(trials)}",
                )  # fmt: skip
            panel.axhline(0.0, color=INK, lw=0.8)
            unit = units[scene, name]
            panel.set(
                xlabel=axis(_words(name), unit), ylabel=axis("estimate − truth", unit), title=_words(scene)
            )
            panel.grid()
            low, high = panel.get_ylim()
            panel.set_ylim(low, high + 0.22 * (high - low))  # room for the legend
            panel.legend(fontsize=8, loc="upper left")
    return fig


def points_chart(body: np.ndarray, observed: np.ndarray, fitted: np.ndarray, t: float) -> Figure:
    """Observed and fitted points from the front and from above, over the fitted body.

    Args:
        body: [P, 3] m; observed, fitted: [n, 3] m, NaN where an axis was not observed; t: when [s].
    """
    shown = body[drawn(len(body), _BODY)]
    with styled():
        fig = figure(4.4)
        for panel, (i, j) in zip(fig.subplots(1, 2), ((0, 2), (0, 1)), strict=True):
            panel.plot(*shown[:, [i, j]].T, ".", ms=3, color=FULL, alpha=0.35, mew=0, label="fitted run")
            panel.plot(*fitted[:, [i, j]].T, "o", mfc="none", color=model_color("recurrence"), label="fitted")
            panel.plot(*observed[:, [i, j]].T, "x", ms=4, color=INK, label="observed")
            panel.set(xlabel=f"{'xyz'[i]} [m]", ylabel=f"{'xyz'[j]} [m]", title=f"t = {t:.4g} s")
            panel.set_aspect("equal", adjustable="datalim")
            panel.grid()
        panel.legend(fontsize=8)
    return fig


def residuals_chart(rows: pd.DataFrame) -> Figure:
    """Residuals over time [mm], of the run by recurrence and of the full-order run.

    Args:
        rows: of residuals.csv.
    """
    end = float(rows["t"].max())
    with styled():
        fig = figure(3.4)
        panel = fig.subplots()
        for k, (column, (name, color)) in enumerate(_RUNS.items()):
            if column in rows:
                t, off = rows["t"] + (k - 0.5) * 0.006 * end, 1e3 * (rows["value"] - rows[column])
                panel.plot(t, off, "o", ms=3, alpha=0.5, label=name, color=color)
        panel.axhline(0.0, color=MUTED, lw=0.8)
        panel.set(xlabel="time t [s]", ylabel="observed − run [mm]")
        panel.set_xlim(0.0, 1.05 * end or None)
        panel.grid()
        panel.legend()
    return fig


def bands_chart(t: np.ndarray, bands: Mapping[str, np.ndarray], levels: Sequence[float]) -> Figure:
    """Quantiles over time [m], a panel each.

    Args:
        t: [F] s.
        bands: by name [Q, F]; levels: [Q] ascending, of which the middle one is drawn as a line.
    """
    middle = len(levels) // 2
    with styled():
        fig = figure(3.2 * len(bands))
        for panel, (name, values) in zip(np.ravel(fig.subplots(len(bands), 1)), bands.items(), strict=True):
            for k in range(middle):
                label = f"{100 * levels[k]:g} to {100 * levels[-1 - k]:g} %"
                shade = {"color": PALETTE[0], "alpha": 0.18 + 0.2 * k, "lw": 0}
                panel.fill_between(t, values[k], values[-1 - k], label=label, **shade)
            panel.plot(t, values[middle], color=PALETTE[0], label="median")
            panel.set(xlabel="time t [s]", ylabel=axis(_words(name), "m"))
            panel.grid()
            panel.legend(fontsize=8)
    return fig


def indices_chart(table: pd.DataFrame) -> Figure:
    """Sensitivity indices with their 95 % intervals, a panel a quantity.

    Args:
        table: quantity, parameter, first, first_95, total, total_95; and first_full_order, first_same_design
            and the same of total, of a smaller design, where there were full-order runs.
    """
    beside = {"same_design": ("x", "recurrence, smaller design"), "full_order": ("o", "full order, the same")}
    groups = list(table.groupby("quantity", sort=False))
    with styled():
        fig = figure(3.2)
        for panel, (name, part) in zip(np.ravel(fig.subplots(1, len(groups))), groups, strict=True):
            at = np.arange(len(part))
            for k, (order, label) in enumerate({"first": "first order", "total": "total"}.items()):
                place, errors = at + 0.36 * (k - 0.5), part[f"{order}_95"]
                panel.bar(place, part[order], 0.34, yerr=errors, label=label, color=PALETTE[k])
                for kind, (mark, who) in beside.items():
                    if f"{order}_{kind}" in part:
                        style = {"ms": 6, "mfc": "none", "color": INK, "label": who if k else None}
                        panel.plot(place + 0.08, part[f"{order}_{kind}"], mark, **style)
            panel.set_xticks(at, part["parameter"].map(_words))
            panel.set(ylabel="share of the variance [–]", title=_words(name))
            panel.grid(axis="y")
        fig.legend(*panel.get_legend_handles_labels(), loc="outside upper left", ncols=4)
    return fig


def posterior_chart(draws: np.ndarray, names: Sequence[str]) -> Figure:
    """Draws of the posterior: each parameter's histogram, and each pair in a plane.

    Args:
        draws: [n, p]; names: [p] with units.
    """
    p = len(names)
    with styled():
        fig = figure(2.6 * p + 0.8)
        panels = fig.subplots(p, p, squeeze=False)
        for i, j in np.ndindex(p, p):
            panel = panels[i, j]
            panel.set(xlabel=names[j], ylabel="density" if i == j else names[i], visible=j <= i)
            if i == j:
                panel.hist(draws[:, i], 50, color=PALETTE[0], alpha=0.8, density=True)
            elif j < i:
                panel.plot(draws[::5, j], draws[::5, i], ".", ms=1.2, alpha=0.3, color=PALETTE[0])
    return fig


def program_chart(t: np.ndarray, ways: Mapping[str, np.ndarray], unit: str) -> Figure:
    """A designed program over time.

    Args:
        t: [N] s; ways: by name [N]; unit: theirs.
    """
    with styled():
        fig = figure(3.2)
        panel = fig.subplots()
        for i, (name, values) in enumerate(ways.items()):
            panel.plot(t, values, label=name, **line_style(i))
        panel.set(xlabel="time t [s]", ylabel=axis("program", unit))
        panel.grid()
        panel.legend()
    return fig


def _words(name: str) -> str:
    return name.replace("_", " ")
