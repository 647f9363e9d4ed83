"""Error over cost: what each solver of a scene needs, and how near it is."""

import itertools
import math
from collections.abc import Mapping, Sequence

from matplotlib.figure import Figure

from nsf.reporting.drawing.levels import LEVELS
from nsf.results.scales import LOST, plain_ticks, set_apart
from nsf.results.style import FULL, INK, MUTED, PALETTE, figure, legend_above, styled

_FULL = "full order"  # begins the names of full-order solvers
_ACROSS = 3  # panels in a row
_COARSE_POINT = {"color": FULL, "marker": "s", "mfc": "white", "mew": 1.6}
_MARKERS = "o^vD"  # of solvers that share a colour
_LINES = ((0, (6, 2)), (0, (2, 1.5)), (0, (1, 3)))


def error_over_cost(
    panels: Mapping[str, Sequence[Mapping]], free: Mapping[str, Mapping[str, float]]
) -> Figure:
    """Displacement error [%] over time [ms], both logarithmic: a panel a scene, a point a solver.

    Args:
        panels: by scene, solvers with `solver`, `kind` (`full`, `coarse` or `reduced`), `span_ms` and
            `displacement_error` (a fraction). The full-order one has no error, and is a vertical line.
        free: by scene, the errors (fractions) of what costs nothing, by name: horizontal lines.
    """
    reduced = dict.fromkeys(s["solver"] for of in panels.values() for s in of if s["kind"] == "reduced")
    styles = solver_styles(list(reduced))
    names = list(dict.fromkeys(name for of in free.values() for name in of))
    rows = math.ceil(len(panels) / _ACROSS)
    with styled():
        fig = figure(0.9 + 3.1 * rows)
        drawn = fig.subplots(rows, min(_ACROSS, len(panels)), squeeze=False).ravel()
        for panel, (scene, solvers) in zip(drawn, panels.items(), strict=False):
            for solver in solvers:
                _point(panel, solver, styles)
            for i, name in enumerate(names):
                if _drawable(error := free.get(scene, {}).get(name)):
                    panel.axhline(100 * error, color=MUTED, ls=_LINES[i % len(_LINES)], lw=1.2, label=name)
            panel.set(xscale="log", yscale="log", title=scene)
            panel.set(xlabel="time for one full-order Δt [ms]", ylabel="displacement error [%]")
            panel.margins(0.12)
            panel.set_ylim(top=min(panel.get_ylim()[1], LOST))
            panel.grid()
            for line in (panel.xaxis, panel.yaxis):
                plain_ticks(line)
        for panel in drawn[len(panels) :]:
            panel.axis("off")
        told = {line.get_label(): line for panel in drawn for line in panel.lines}
        legend_above(fig, told.values(), told.keys(), 4)
        set_apart(fig)
    return fig


def step_over_particles(panels: Mapping[str, Mapping[str, Mapping[int, float]]]) -> Figure:
    """Time for one full-order Δt [ms] over the number of particles, both logarithmic: a panel a scene.

    Args:
        panels: by scene, then by solver, the time [ms] at each number of particles; NaN where not measured.
    """
    names = list(dict.fromkeys(name for of in panels.values() for name in of))
    styles = solver_styles([name for name in names if not name.startswith(_FULL)])
    coarse = [name for name in names if name not in (_FULL, *styles)]
    rows = math.ceil(len(panels) / _ACROSS)
    with styled():
        fig = figure(0.9 + 3.4 * rows)
        drawn = fig.subplots(rows, min(_ACROSS, len(panels)), squeeze=False).ravel()
        for panel, (scene, solvers) in zip(drawn, panels.items(), strict=False):
            for name, times in solvers.items():
                style = {"color": FULL, "marker": "o"} | styles.get(name, {})
                if name in coarse:
                    style = {"ls": _LINES[coarse.index(name) % len(_LINES)]} | _COARSE_POINT
                panel.plot(list(times), list(times.values()), ms=5, label=name, **style)
            sizes = sorted({size for times in solvers.values() for size in times})
            panel.set(xscale="log", yscale="log", title=scene)
            panel.set(xlabel="particles [–]", ylabel="time for one full-order Δt [ms]")
            panel.set_xticks(sizes, [f"{size:,}" for size in sizes])
            panel.minorticks_off()
            panel.grid()
            plain_ticks(panel.yaxis)
        for panel in drawn[len(panels) :]:
            panel.axis("off")
        told = {line.get_label(): line for panel in drawn for line in panel.lines}
        legend_above(fig, told.values(), told.keys(), 4)
    return fig


def solver_styles(names: Sequence[str]) -> dict[str, dict]:
    """Colour and marker of each reduced solver; operators and projected steps have the colours of levels.

    Once the colours are used up, markers change.
    """
    known = {
        next((n for n in names if "operators" in n), None): LEVELS["operators"],
        next((n for n in names if "operators" not in n), None): LEVELS["projected step"],
    }
    others = itertools.cycle(color for color in PALETTE if color not in known.values())
    colors = [known.get(n) or next(others) for n in names]
    marks = [_MARKERS[colors[:i].count(color) % len(_MARKERS)] for i, color in enumerate(colors)]
    return {n: {"color": c, "marker": m} for n, c, m in zip(names, colors, marks, strict=True)}


def _point(panel, solver: Mapping, styles: Mapping[str, dict]) -> None:
    """One solver, where its time and error are known."""
    name, x, y = solver["solver"], solver["span_ms"], solver["displacement_error"]
    if solver["kind"] == "full":
        if _drawable(x):
            panel.axvline(x, color=FULL, lw=1.6, label=name)
    elif _drawable(x) and _drawable(y):
        if solver["kind"] == "coarse":
            panel.plot(x, 100 * y, label="full order on coarser grids", ls="", ms=7, **_COARSE_POINT)
            panel.annotate(
                name.rpartition(" ")[2] + "Δx", (x, 100 * y), (5, 4), textcoords="offset points", color=INK
            )
        else:
            panel.plot(x, 100 * y, ls="", ms=7, label=name, **styles[name])


def _drawable(value) -> bool:
    return value is not None and math.isfinite(value) and value > 0
