"""Errors of held-out cases over the parameters of a scene that has several, or one and forcing programs."""

import math
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import matplotlib
import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.transforms import offset_copy

from nsf.reporting.drawing.cost import solver_styles
from nsf.reporting.text.columns import axis, number
from nsf.results.formats import plain
from nsf.results.scales import LOST, error_scale, plain_ticks
from nsf.results.style import FULL, INK, WARNING, WIDTH, figure, legend_above, styled

_ACROSS, _MAPS = 3, 4  # panels in a row: of one parameter, and of two
_FEWEST = 6  # cases of which means of neighbours say anything
_CROSS = {"ls": "", "marker": "x", "ms": 4, "mew": 0.9, "color": "#aaaaaa"}
_LOST = {"ls": "", "marker": "X", "ms": 9, "mec": "white", "mew": 0.8, "color": WARNING}
COLORS = "viridis"  # of the maps
_SIZE, _WIDEST = 9, 28  # [pt] of what stands above a map, and letters of a line there
_STEP = 11  # [pt] from a row of lost runs to the next
_BAR = "displacement error [%]"


@dataclass(frozen=True)
class Parameter:
    """An axis: a parameter's name and unit, and whether its design is logarithmic."""

    name: str
    unit: str
    log: bool


@dataclass(frozen=True)
class Cases:
    """The held-out cases of a body, and how far each solver is off in them.

    Attributes:
        body: what moves, as a reader calls it.
        parameters: the k axes.
        errors: by solver, the cases [n, k] in the units of the parameters, and their displacement errors [n],
            fractions, ∞ where a run diverged.
        trained: the cases that were trained on [m, k]; none where they are not known.
    """

    body: str
    parameters: Sequence[Parameter]
    errors: Mapping[str, tuple[np.ndarray, np.ndarray]]
    trained: np.ndarray

    @property
    def ranked(self) -> list[str]:
        """Solvers, the best first: by the number of lost runs, and by the mean error of the others."""
        return sorted(self.errors, key=lambda name: _rank(self.errors[name][1]))


def error_over_parameters(bodies: Sequence[Cases]) -> Figure:
    """Displacement error [%] over each parameter of each body, a panel each: a dot a case and solver.

    Where a solver has cases enough, a line of means over neighbouring ones, from the smallest to the largest
    of which a band goes. Lost runs are crosses above the panel.
    """
    panels = [(cases, k) for cases in bodies for k in range(len(cases.parameters))]
    styles = solver_styles(list(dict.fromkeys(name for cases in bodies for name in cases.errors)))
    rows = math.ceil(len(panels) / _ACROSS)
    with styled():
        fig = figure(0.8 + 3.0 * rows)
        drawn = fig.subplots(rows, min(_ACROSS, len(panels)), squeeze=False).ravel()
        for panel, (cases, k) in zip(drawn, panels, strict=False):
            lost = [name for name in cases.errors if _lost(cases.errors[name][1]).any()]
            for name, (points, errors) in cases.errors.items():
                _over(panel, points[:, k], 100 * errors, styles[name], cases.parameters[k].log)
                if name in lost:
                    _off(panel, points[_lost(errors), k], styles[name]["color"], lost.index(name))
            panel.set_title(cases.body if len(bodies) > 1 else "", pad=6 + _STEP * len(lost))
            panel.set(ylabel=_BAR)
            _scaled(panel, cases, x=k)
            every = np.concatenate([errors for _, errors in cases.errors.values()])
            error_scale(panel, 100 * (every[~_lost(every)] if not _lost(every).all() else np.ones(1)))
        for panel in drawn[len(panels) :]:
            panel.axis("off")
        known = [Line2D([], [], ls="-", ms=5, label=name, **style) for name, style in styles.items()]
        if any(_lost(errors).any() for cases in bodies for _, errors in cases.errors.values()):
            known.append(Line2D([], [], **_LOST | {"color": FULL}, label="lost"))
        legend_above(fig, known, [line.get_label() for line in known], 4)
    return fig


def error_maps(bodies: Sequence[Cases]) -> Figure:
    """Displacement error [%] over the plane of two parameters: a panel a solver, the best of a body first.

    A dot a held-out case, on one colour scale for all; a cross a lost one, a small grey one a training case.
    """
    rows = [(cases, i) for cases in bodies for i in range(0, len(cases.errors), _MAPS)]
    columns = min(_MAPS, max(len(cases.errors) for cases in bodies))
    scale = _colors_of(bodies)
    with styled():
        fig = figure(0.9 + 2.45 * len(rows), min(WIDTH, 2.0 + 2.4 * columns))
        drawn = fig.subplots(len(rows), columns, squeeze=False)
        for across, (cases, start) in zip(drawn, rows, strict=True):
            shown = cases.ranked[start : start + columns]
            for i, (panel, name) in enumerate(zip(across, shown, strict=False)):
                _map(panel, cases, name, scale)
                said = [*textwrap.wrap(plain(name), _WIDEST), _said(cases.errors[name][1])]
                panel.text(0, 1.03, "\n".join(said), transform=panel.transAxes, va="bottom", fontsize=_SIZE)
                if i:
                    panel.set_ylabel("")
                    panel.tick_params(labelleft=False)
                elif len(bodies) > 1 and not start:
                    panel.set_title(cases.body, pad=6 + 1.35 * _SIZE * len(said))
            for panel in across[len(shown) :]:
                panel.axis("off")
        bar = fig.colorbar(scale, ax=drawn, label=_BAR, aspect=16 * len(rows))
        plain_ticks(bar.ax.yaxis)
        bar.outline.set_visible(False)
        fig.legend(handles=_keys(bodies), loc="outside upper left", ncols=3)
    return fig


def _over(panel, x: np.ndarray, error: np.ndarray, style: Mapping[str, str], log: bool) -> None:
    """Dots of one solver [%], and their means over neighbours where they are enough."""
    order = np.argsort(x, kind="stable")
    x, error = x[order], np.where(_lost(error / 100), np.nan, error)[order]
    color = style["color"]
    panel.plot(x, error, style["marker"], ms=4.5, mfc="white", mec=color, mew=1.1, alpha=0.9)
    shown = error[~np.isnan(error)]
    panel.update_datalim([(at, shown[0] if len(shown) else 100.0) for at in x])  # of lost ones too
    if len(x) < _FEWEST:
        return
    windows = [np.lib.stride_tricks.sliding_window_view(v, _window(len(x))) for v in (x, error)]
    at = np.exp(np.log(windows[0]).mean(1)) if log else windows[0].mean(1)
    # A lost run leaves a gap: it is never averaged around.
    panel.fill_between(at, windows[1].min(1), windows[1].max(1), color=color, alpha=0.18, linewidth=0)
    panel.plot(at, windows[1].mean(1), color=color)


def _off(panel, x: np.ndarray, color: str, row: int) -> None:
    """Crosses of the lost runs of one solver, above the panel: a row of them a solver."""
    above = offset_copy(panel.get_xaxis_transform(), panel.figure, y=_STEP * (row + 0.6), units="points")
    panel.plot(x, np.ones(len(x)), transform=above, clip_on=False, **_LOST | {"color": color})


def _window(cases: int) -> int:
    """How many neighbours a mean is over: more of more cases, and still a small part of them."""
    return math.ceil(math.sqrt(cases)) + 1


def _map(panel, cases: Cases, name: str, scale: ScalarMappable) -> None:
    points, errors = cases.errors[name]
    lost = _lost(errors)
    panel.plot(*cases.trained.T, zorder=1, **_CROSS)
    panel.scatter(
        *points[~lost].T, s=52, c=scale.to_rgba(100 * errors[~lost]), edgecolors=INK, linewidths=0.8, zorder=2
    )
    panel.plot(*points[lost].T, zorder=3, **_LOST)
    _scaled(panel, cases, x=0, y=1)
    panel.margins(0.06)
    panel.grid()


def _scaled(panel, cases: Cases, **axes: int) -> None:
    """Name axes by parameters, with their units; those of a logarithmic design are logarithmic."""
    for which, k in axes.items():
        one = cases.parameters[k]
        panel.set(**{f"{which}label": axis(one.name, one.unit)})
        line = getattr(panel, f"{which}axis")
        if one.log:
            panel.set(**{f"{which}scale": "log"})
            plain_ticks(line)
        else:
            panel.locator_params(axis=which, nbins=4)


def _colors_of(bodies: Sequence[Cases]) -> ScalarMappable:
    """One scale [%] for all errors that are not lost, logarithmic."""
    errors = np.concatenate([errors for cases in bodies for _, errors in cases.errors.values()])
    shown = 100 * errors[~_lost(errors) & (errors > 0)]
    low, high = (shown.min(), shown.max()) if len(shown) else (1.0, LOST)
    norm = LogNorm(low, max(high, 1.1 * low), clip=True)
    return ScalarMappable(norm, matplotlib.colormaps[COLORS])


def _keys(bodies: Sequence[Cases]) -> list[Line2D]:
    """What each mark means that is there."""
    known = [Line2D([], [], ls="", marker="o", ms=7, mfc="white", mec=INK, label="held-out case")]
    if any(_lost(errors).any() for cases in bodies for _, errors in cases.errors.values()):
        known.append(Line2D([], [], **_LOST, label="lost"))
    if any(len(cases.trained) for cases in bodies):
        known.append(Line2D([], [], **_CROSS, label="training case"))
    return known


def _said(errors: np.ndarray) -> str:
    """The mean, or how many are lost."""
    lost = int(_lost(errors).sum())
    return f"{lost} of {len(errors)} lost" if lost else f"mean {number(errors.mean(), 100)} %"


def _rank(errors: np.ndarray) -> tuple[int, float]:
    lost = _lost(errors)
    return int(lost.sum()), float(errors[~lost].mean()) if not lost.all() else math.inf


def _lost(errors: np.ndarray) -> np.ndarray:
    """Which runs diverged, or are off by so much that it tells nothing."""
    return ~(100 * errors <= LOST)
