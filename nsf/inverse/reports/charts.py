"""Charts of estimates: data in, figure out, units on every axis."""

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from nsf.reporting.text.columns import axis
from nsf.results.style import FULL, INK, MUTED, PALETTE, figure, line_style, styled

_BODY = 1500  # particles that show a body


def trials_chart(table: pd.DataFrame, reach: np.ndarray, units: Mapping[tuple[str, str], str]) -> Figure:
    """What each estimate is off, with its 90 % interval, over the truth: a panel a scene and parameter.

    Args:
        table: rows of results.csv.
        reach: [rows, 2] of the interval below and above the estimate.
        units: of the parameters, by scene and name.
    """
    groups = list(table.groupby(["scene", "parameter"], sort=False))
    with styled():
        fig = figure(3.4 * ((len(groups) + 1) // 2))
        panels = np.ravel(fig.subplots((len(groups) + 1) // 2, min(2, len(groups)), squeeze=False))
        for panel, ((scene, name), part) in zip(panels, groups, strict=False):
            off = part["estimate"] - part["truth"]
            held = part["inside_90"] == 1
            for chosen, color, told in ((held, PALETTE[0], "holds"), (~held, PALETTE[1], "misses")):
                if not chosen.any():
                    continue
                bars = reach[part.index[chosen]].T
                panel.errorbar(
                    part["truth"][chosen], off[chosen], bars, fmt="o", ms=3.5, lw=1.1, color=color,
                    label=f"interval {told} the truth: {chosen.sum()}",
                )  # fmt: skip
            panel.axhline(0.0, color=INK, lw=0.8)
            unit = units[scene, name]
            shown = name.replace("_", " ")
            panel.set(
                xlabel=axis(shown, unit), ylabel=axis("estimate − truth", unit), title=scene.replace("_", " ")
            )
            panel.grid()
            low, high = panel.get_ylim()
            panel.set_ylim(low, high + 0.22 * (high - low))  # room for the legend
            panel.legend(fontsize=8, loc="upper left")
        for panel in panels[len(groups) :]:
            panel.set_visible(False)
    return fig


def points_chart(body: np.ndarray, observed: np.ndarray, fitted: np.ndarray, t: float) -> Figure:
    """Observed and fitted points from the front and from above, over the fitted body.

    Args:
        body: [P, 3] m; observed, fitted: [n, 3] m, NaN where an axis was not observed; t: when [s].
    """
    shown = body[np.random.default_rng(0).permutation(len(body))[:_BODY]]
    with styled():
        fig = figure(4.4)
        for panel, (i, j) in zip(fig.subplots(1, 2), ((0, 2), (0, 1)), strict=True):
            panel.scatter(shown[:, i], shown[:, j], s=3, color=FULL, alpha=0.35, lw=0, label="fitted run")
            panel.scatter(
                fitted[:, i], fitted[:, j], s=34, facecolor="none", edgecolor=PALETTE[0], label="fitted"
            )
            panel.scatter(
                observed[:, i], observed[:, j], s=18, marker="x", color=PALETTE[1], label="observed"
            )
            panel.set(xlabel=f"{'xyz'[i]} [m]", ylabel=f"{'xyz'[j]} [m]", title=f"t = {t:.4g} s")
            panel.set_aspect("equal", adjustable="datalim")
            panel.grid()
        panel.legend(fontsize=8)
    return fig


def residuals_chart(rows: pd.DataFrame, less: str = "observed") -> Figure:
    """Residuals over time [mm], of the run by operators and of the full-order run.

    Args:
        rows: of residuals.csv; less: what `value` is.
    """
    with styled():
        fig = figure(3.4)
        panel = fig.subplots()
        for k, (column, told) in enumerate(
            (("fitted", "run by operators"), ("full_order", "full-order run"))
        ):
            if column in rows:
                off = 1e3 * (rows["value"] - rows[column])
                jitter = (k - 0.5) * 0.006 * float(rows["t"].max())
                panel.plot(rows["t"] + jitter, off, "o", ms=3, alpha=0.5, label=told, color=PALETTE[k])
        panel.axhline(0.0, color=MUTED, lw=0.8)
        panel.set(xlabel="time t [s]", ylabel=f"{less} − run [mm]")
        panel.set_xlim(0.0, 1.05 * float(rows["t"].max()) or None)
        panel.grid()
        panel.legend()
    return fig


def bands_chart(
    t: np.ndarray, bands: Mapping[str, np.ndarray], levels: Sequence[float], units: str
) -> Figure:
    """Quantiles over time, a panel each.

    Args:
        t: [F] s.
        bands: by name [Q, F]; levels: [Q] ascending, of which the middle one is drawn as a line.
        units: of the values.
    """
    with styled():
        fig = figure(3.2 * len(bands))
        for panel, (name, values) in zip(np.ravel(fig.subplots(len(bands), 1)), bands.items(), strict=True):
            middle = len(levels) // 2
            for k in range(middle):
                told = f"{100 * levels[k]:g} to {100 * levels[-1 - k]:g} %"
                panel.fill_between(
                    t, values[k], values[-1 - k], color=PALETTE[0], alpha=0.18 + 0.2 * k, lw=0, label=told
                )
            panel.plot(t, values[middle], color=PALETTE[0], label="median")
            panel.set(xlabel="time t [s]", ylabel=axis(name.replace("_", " "), units))
            panel.grid()
            panel.legend(fontsize=8)
    return fig


def indices_chart(table: pd.DataFrame) -> Figure:
    """Sensitivity indices with their 95 % intervals, a panel a quantity.

    Args:
        table: quantity, parameter, first, first_95, total, total_95; and first_full_order, first_same_design
            and the same of total, of a smaller design, where there were full-order runs.
    """
    beside = (("same_design", "x", "operators, smaller design"), ("full_order", "o", "full order, the same"))
    groups = list(table.groupby("quantity", sort=False))
    with styled():
        fig = figure(3.2)
        for panel, (name, part) in zip(np.ravel(fig.subplots(1, len(groups))), groups, strict=True):
            at = np.arange(len(part))
            for k, (column, told) in enumerate((("first", "first order"), ("total", "total"))):
                panel.bar(
                    at + 0.36 * (k - 0.5), part[column], 0.34, yerr=part[f"{column}_95"], label=told,
                    color=PALETTE[k],
                )  # fmt: skip
                for kind, mark, who in beside:
                    if f"{column}_{kind}" in part:
                        panel.plot(
                            at + 0.36 * (k - 0.5) + 0.08, part[f"{column}_{kind}"], mark, ms=6, mfc="none",
                            color=INK, label=who if k else None,
                        )  # fmt: skip
            panel.set_xticks(at, [p.replace("_", " ") for p in part["parameter"]])
            panel.set(ylabel="share of the variance [–]", title=name.replace("_", " "))
            panel.grid(axis="y")
        fig.legend(*panel.get_legend_handles_labels(), loc="outside upper left", ncols=4)
    return fig


def posterior_chart(draws: np.ndarray, names: Sequence[str], units: Sequence[str]) -> Figure:
    """Draws of the posterior: each parameter's histogram, and each pair in a plane.

    Args:
        draws: [n, p]; names, units: [p].
    """
    p = len(names)
    with styled():
        fig = figure(2.6 * p + 0.8)
        panels = fig.subplots(p, p, squeeze=False)
        for i in range(p):
            for j in range(p):
                panel = panels[i, j]
                if j > i:
                    panel.set_visible(False)
                    continue
                if i == j:
                    panel.hist(draws[:, i], 50, color=PALETTE[0], alpha=0.8, density=True)
                    panel.set_ylabel(axis("density", f"1/{units[i]}" if units[i] else ""))
                else:
                    panel.plot(draws[::5, j], draws[::5, i], ".", ms=1.2, alpha=0.3, color=PALETTE[0])
                    panel.set_ylabel(axis(names[i].replace("_", " "), units[i]))
                panel.set_xlabel(axis(names[j].replace("_", " "), units[j]))
    return fig


def program_chart(t: np.ndarray, ways: Mapping[str, np.ndarray], unit: str) -> Figure:
    """What was designed over time.

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
