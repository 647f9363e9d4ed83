"""Marks, names and numbers that several charts draw."""

import textwrap
from collections.abc import Iterable, Sequence

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from nsf.results.columns import COLUMNS
from nsf.results.style import DASHES, model_color, panels
from nsf.results.table import BEYOND, TAKEN

_LINE = 60  # letters of a label beside a chart, in a line; beside one of two panels in a row
_HALF = 40
_MARKERS = "o^vDsP"
ERROR = COLUMNS["displacement_error"].heading


def styles(frame: pd.DataFrame, by: str) -> dict[str, dict]:
    """Colour, dash, marker and label of each name in a column.

    A model has one colour in every chart; several of its settings, or cases, have shades of it, dashes and
    markers.
    """
    model_of = frame.drop_duplicates(by).set_index(by, drop=False)["model_name"].to_dict()
    drawn = {}
    for model in dict.fromkeys(model_of.values()):
        names = [name for name in model_of if model_of[name] == model]
        shades = list(dict.fromkeys(map(base, names)))
        for k, name in enumerate(names):
            drawn[name] = {
                "color": model_color(model, shades.index(base(name)), len(shades)),
                "linestyle": DASHES[k % len(DASHES)],
                "marker": _MARKERS[k % len(_MARKERS)],
                "label": name,
            }
    return drawn


def base(variant: str) -> str:
    """A variant without what is said of some of its rows."""
    return variant.removesuffix(BEYOND).removesuffix(TAKEN)


def line(style: dict) -> dict:
    """Colour, dash and label of a style."""
    return {key: style[key] for key in ("color", "linestyle", "label")}


def mark(style: dict) -> dict:
    """Colour, marker and label of a style."""
    return {key: style[key] for key in ("color", "marker", "label")}


def row_names(averages: pd.DataFrame) -> list[str]:
    """Names of the rows of `means`, in lines; the body alone, or the variant alone, where that tells them."""
    bodies, kinds = averages["body"].nunique(), averages["variant"].nunique()
    names = averages["body"] + (" · " + averages["variant"] if kinds > 1 else "")
    return in_lines(averages["variant"] if bodies == 1 and kinds > 1 else names)


def in_lines(names: Iterable[str], panels: int = 1) -> list[str]:
    """Names beside one of so many panels; a longer one has a line for each of its parts, or more."""
    width = _LINE if panels == 1 else _HALF

    def lines_of(name: str) -> list[str]:
        return [part for parts in name.split(" · ") for part in textwrap.wrap(parts, width)]

    return [name if len(name) <= width else "\n".join(lines_of(name)) for name in names]


def row_panels(counts: Sequence[int], each: float, more: float, **shared) -> tuple[Figure, list[Axes]]:
    """Panels, two in a row, as high as the larger of both numbers of rows asks, whose distance is one in all.

    Args:
        counts: rows of each panel.
        each: height of a row [inch]; more: of what is about the rows.
        shared: options as of `subplots`.
    """
    most = [max(counts[i // 2 * 2 :][:2]) for i in range(len(counts))]
    fig, drawn = panels(len(counts), [more + each * rows for rows in most], 2, **shared)
    for panel, rows in zip(drawn, most, strict=True):
        panel.set_ylim(rows - 0.45, -0.55)
        panel.tick_params(axis="y", length=0)
    return fig, drawn


def whole_mean(values: pd.Series) -> float:
    """The mean; missing where one value is."""
    return values.mean(skipna=False)


def finite(values) -> np.ndarray:
    """Values with gaps where they are not finite: a run that diverged has no line from there on."""
    values = np.array(values, float)
    values[~np.isfinite(values)] = np.nan
    return values
