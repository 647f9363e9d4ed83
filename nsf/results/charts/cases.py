"""Charts of scenes whose cases have several parameters, or forcing programs."""

import math
import textwrap
from collections.abc import Iterator

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from nsf.data.case import PROGRAM, Case
from nsf.errors import ConfigError
from nsf.results.charts.drawing import ERROR, base, styles, whole_mean
from nsf.results.charts.view import Figures, View, chart
from nsf.results.columns import axis, number
from nsf.results.style import (
    INK,
    LOST,
    LOST_MARK,
    MUTED,
    WARNING,
    WIDTH,
    error_scale,
    figure,
    legend,
    panels,
    plain_ticks,
)
from nsf.results.table import BEYOND

COLORS = "viridis"
"""Colour scale of the maps of errors."""
_CROSS = {"ls": "", "marker": "x", "ms": 4, "mew": 0.9, "color": "#aaaaaa"}
_MAPS = 4  # in a row
_MOST = 6  # variants over a parameter
_WIDEST = 28  # letters of a line above a map


@chart(
    "Displacement error of held-out cases over each parameter, a dot a case, its mean over seeds, filled "
    "where it led beyond what was taught. Crosses above are lost: they diverged or are off by more than "
    "1,000 %."
)
def error_over_parameters(view: View) -> Figures:
    """Errors over each parameter of each body, a panel each."""
    planes = [(body, _few(part), name) for body, part, names in _several(view) for name in names]
    if not planes:
        return {}
    drawn = styles(view.frame.assign(variant=view.frame["variant"].map(base)), "variant")
    fig, each = panels(len(planes), 3.0, 3)
    for panel, (body, part, name) in zip(each, planes, strict=True):
        lost = 0  # rows of crosses
        for variant, rows in part.groupby("variant", sort=False):
            lost += _crosses(panel, rows[name][rows["lost"]], drawn[variant]["color"], lost)
            _dots(panel, rows, name, drawn[variant])
        panel.set_title(body, pad=14 + 9 * max(0, lost - 1))
        panel.set(ylabel=ERROR)
        _scaled(panel, "x", part, name, name in view.logarithmic)
        error_scale(panel, 100 * part["error"][~part["lost"]])
    if any(part["beyond"].any() for _, part, _ in planes):
        each[-1].plot([], [], "o", ms=4.5, color=MUTED, label="filled: beyond what was taught")
    legend(fig)
    return {"error-over-parameters": fig}


@chart(
    "Displacement error of held-out cases in the plane of both parameters, a dot a case, its mean over "
    "seeds: a panel a model, the best first, and one colour scale. Grey crosses are training cases."
)
def error_map(view: View) -> Figures:
    """Errors in the plane of two parameters, a panel a variant."""
    planes = [(body, part, names) for body, part, names in _several(view) if len(names) == 2]
    return {"error-map": _maps(view, planes)} if planes else {}


def _maps(view: View, planes: list) -> Figure:
    rows = []
    for body, part, names in planes:
        ranked = sorted(part.groupby("variant", sort=False), key=lambda one: _rank(_within(one[1])))
        rows += [(body, names, ranked[i : i + _MAPS]) for i in range(0, len(ranked), _MAPS)]
    columns = max(len(ranked) for *_, ranked in rows)
    scale = _colors(100 * pd.concat([part["error"] for _, part, _ in planes]))
    fig = figure(0.9 + 2.45 * len(rows), min(WIDTH, 2.0 + 2.4 * columns))
    grid = fig.subplots(len(rows), columns, squeeze=False)
    for across, (body, names, ranked) in zip(grid, rows, strict=True):
        for panel, (variant, cases) in zip(across, ranked, strict=False):
            _map(panel, view, cases, names, scale)
            title = [body, *textwrap.wrap(variant, _WIDEST), _summary(cases)]
            panel.set_title("\n".join(title), fontsize=9, fontweight="normal")
        for panel in across[len(ranked) :]:
            panel.axis("off")
    bar = fig.colorbar(scale, ax=grid, label=ERROR, aspect=16 * len(rows))
    plain_ticks(bar.ax.yaxis)
    bar.outline.set_visible(False)
    marks = [Line2D([], [], ls="", marker="o", ms=7, mfc="white", mec=INK, label="held-out case")]
    if any(part["beyond"].any() for _, part, _ in planes):
        beyond = {"marker": "s", "ms": 7, "mfc": "white", "mec": INK, "label": "beyond what was taught"}
        marks.append(Line2D([], [], ls="", **beyond))
    marks += [Line2D([], [], **LOST_MARK, color=WARNING, label="lost")]
    marks += [Line2D([], [], **_CROSS, label="training case")] if view.trained else []
    fig.legend(handles=marks, loc="outside upper left", ncols=4)
    return fig


def _few(part: pd.DataFrame) -> pd.DataFrame:
    """The rows of a body; where they would not be told apart, of the best variant of each model."""
    if part["variant"].nunique() <= _MOST:
        return part
    ranked = sorted(part.groupby("variant", sort=False), key=lambda one: _rank(_within(one[1])))
    return pd.concat({of["model_name"].iloc[0]: of for _, of in reversed(ranked)}.values())


def _several(view: View) -> Iterator[tuple[str, pd.DataFrame, list[str]]]:
    """Bodies whose cases have several values: their rows with a column a parameter, and these names.

    Errors are means over seeds, a row a case and variant, but for runs that the fallback took. `lost` says
    whether a run diverged or is off by more than `LOST`, `beyond` whether it led beyond what was taught.
    """
    shown = view.frame[view.frame["fallback_share"].fillna(0) == 0]
    shown = shown.assign(beyond=shown["variant"].str.endswith(BEYOND), variant=shown["variant"].map(base))
    for body, part in shown.groupby("body", sort=False):
        try:
            cases = {text: Case.read(text) for text in part["case"].unique()}
        except ConfigError:
            continue
        names = [name for name in next(iter(cases.values())) if name != PROGRAM]
        if all(len(case) < 2 for case in cases.values()) or not names:
            continue
        by = ["scene", "model_name", "variant", "case", "beyond"]
        errors = part.groupby(by, sort=False)["displacement_error"]
        rows = errors.agg(whole_mean).rename("error").reset_index().dropna(subset="error")
        rows["lost"] = ~(100 * rows["error"] <= LOST)
        yield body, rows.assign(**{n: [cases[text][n] for text in rows["case"]] for n in names}), names


def _crosses(panel, at: pd.Series, color: str, row: int) -> bool:
    """Crosses above the panel for cases of one variant that are lost, in a row apart; whether any is."""
    if not len(at):  # an empty line outside the axes would upset the layout
        return False
    above = {"transform": panel.get_xaxis_transform(), "clip_on": False}
    panel.plot(at, np.full(len(at), 1.03 + 0.06 * row), color=color, **LOST_MARK, **above)
    if row == 0:
        place = {"transform": panel.transAxes, "ha": "right", "va": "center", "fontsize": 9, "color": MUTED}
        panel.text(-0.02, 1.03, "lost", **place)
    return True


def _dots(panel, rows: pd.DataFrame, name: str, style: dict) -> None:
    """Errors of one variant [%] over a parameter, filled where a case led beyond what was taught."""
    dots = {"ls": "", "ms": 4.5, "mew": 1.1, "alpha": 0.9, "color": style["color"], "marker": style["marker"]}
    for beyond, part in rows[~rows["lost"]].groupby("beyond"):
        shown = {"mfc": style["color"]} if beyond else {"mfc": "white", "label": style["label"]}
        panel.plot(part[name], 100 * part["error"], **shown, **dots)


def _map(panel, view: View, cases: pd.DataFrame, names: list[str], scale: ScalarMappable) -> None:
    trained = view.trained.get(cases["scene"].iloc[0], ())
    crosses = np.array([[case[name] for name in names] for case in trained if case.keys() >= {*names}])
    panel.plot(*crosses.reshape(-1, 2).T, zorder=1, **_CROSS)
    for beyond, part in cases[~cases["lost"]].groupby("beyond"):
        face = {"c": scale.to_rgba(100 * part["error"]), "edgecolors": INK, "linewidths": 0.8}
        panel.scatter(*(part[name] for name in names), s=52, marker="os"[beyond], zorder=2, **face)
    panel.plot(*(cases[name][cases["lost"]] for name in names), zorder=3, color=WARNING, **LOST_MARK)
    for which, name in zip("xy", names, strict=True):
        _scaled(panel, which, cases, name, name in view.logarithmic)
    panel.margins(0.06)
    panel.grid()


def _scaled(panel, which: str, rows: pd.DataFrame, name: str, log: bool) -> None:
    """Name an axis by a parameter with its unit; that of a logarithmic design is logarithmic."""
    case = Case.read(rows["case"].iloc[0])
    unit = dict(zip(case.names, case.units, strict=True))[name]
    panel.set(**{f"{which}label": axis(name.replace("_", " "), unit)})
    if log:
        panel.set(**{f"{which}scale": "log"})
        plain_ticks(getattr(panel, f"{which}axis"))
    else:
        panel.locator_params(axis=which, nbins=4)


def _colors(errors: pd.Series) -> ScalarMappable:
    """One logarithmic scale [%] for all errors that are not lost."""
    shown = errors[(errors <= LOST) & (errors > 0)]
    low, high = (shown.min(), shown.max()) if len(shown) else (1.0, LOST)
    return ScalarMappable(LogNorm(low, max(high, 1.1 * low), clip=True), matplotlib.colormaps[COLORS])


def _within(cases: pd.DataFrame) -> pd.Series:
    """Errors of cases that led nowhere beyond what was taught; all where there are no others."""
    return cases["error"][~cases["beyond"] | cases["beyond"].all()]


def _summary(cases: pd.DataFrame) -> str:
    """The mean of those within what was taught, or how many of all are lost."""
    lost = int(cases["lost"].sum())
    return f"{lost} of {len(cases)} lost" if lost else f"mean {number(_within(cases).mean(), 100)} %"


def _rank(errors: pd.Series) -> tuple[int, float]:
    lost = ~(100 * errors <= LOST)
    return int(lost.sum()), float(errors[~lost].mean()) if not lost.all() else math.inf
