"""Marks, names and numbers that several charts draw."""

import textwrap
from collections.abc import Iterable

import numpy as np
import pandas as pd

from nsf.results.columns import COLUMNS
from nsf.results.style import PALETTE, line_style

_LINE = 60  # letters of a label beside a chart, in a line
_MARKERS = "o^vDsP"
ERROR = COLUMNS["displacement_error"].heading


def lines(names: Iterable[str]) -> dict[str, dict]:
    """Colour, dash and label of the line of each name."""
    return {name: line_style(i) | {"label": name} for i, name in enumerate(dict.fromkeys(names))}


def marks(names: Iterable[str]) -> dict[str, dict]:
    """Colour, marker and label of each name."""
    return {
        name: {
            "color": PALETTE[i % len(PALETTE)],
            "marker": _MARKERS[i // len(PALETTE) % len(_MARKERS)],
            "label": name,
        }
        for i, name in enumerate(dict.fromkeys(names))
    }


def row_names(averages: pd.DataFrame) -> list[str]:
    """Names of the rows of `means`, in lines; the body alone, or the variant alone, where that tells them."""
    bodies, kinds = averages["body"].nunique(), averages["variant"].nunique()
    names = averages["body"] + (" · " + averages["variant"] if kinds > 1 else "")
    names = averages["variant"] if bodies == 1 and kinds > 1 else names
    return ["\n".join(textwrap.wrap(name, _LINE, break_on_hyphens=False)) for name in names]


def whole_mean(values: pd.Series) -> float:
    """The mean; missing where one value is."""
    return values.mean(skipna=False)


def finite(values) -> np.ndarray:
    """Values with gaps where they are not finite: a run that diverged has no line from there on."""
    values = np.array(values, float)
    values[~np.isfinite(values)] = np.nan
    return values
