"""Logarithmic axes with plain numbers, which stand apart."""

import itertools
import math
from collections.abc import Callable, Sequence

import numpy as np
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from nsf.reporting.drawing.style import LETTER

LOST = 1000.0  # [%] error from which a run is lost, by how much tells nothing: axes end there


def error_scale(panel, values) -> None:
    """Logarithmic once the errors span more than a factor of 30, else linear from zero; to `LOST` at most."""
    values = np.asarray(values, float)
    values = np.minimum(values[np.isfinite(values) & (values > 0)], LOST)
    panel.grid(axis="y")
    if len(values) and np.max(values) > 30 * np.quantile(values, 0.05):
        panel.set_yscale("log")
        panel.set_ylim(np.quantile(values, 0.02) / 1.6, np.max(values) * 1.6)
        plain_ticks(panel.yaxis)
    else:
        panel.set_ylim(0, 1.08 * np.max(values, initial=1e-12))


def plain_ticks(axis_line, text: Callable[[float], str] = "{:g}".format) -> None:
    """Give a logarithmic axis ticks as plain numbers, or as `text` says: at 1, 2 and 5 of a decade.

    At more of it where the axis spans less than a factor of 4, at 1 alone from three decades on, and at fewer
    below an axis that has no room for their numbers. For once its limits stand, and its place (`laid_out`).
    """
    low, high = axis_line.get_view_interval()
    few = (1, 2, 5) if high < 1e3 * low else (1,)
    subs = (1, 1.2, 1.5, 2, 2.5, 3, 4, 5, 6, 8) if high < 4 * low else few
    if axis_line.axis_name == "x":
        sparser = [some for some in (subs, few, (1, 3), (1,)) if len(_ticks(axis_line, some)) > 1]
        subs = next((some for some in sparser if _have_room(axis_line, some, text)), (sparser or [subs])[-1])
    axis_line.set_major_locator(LogLocator(subs=subs))
    axis_line.set_major_formatter(FuncFormatter(lambda v, _: text(v)))
    axis_line.set_minor_formatter(NullFormatter())


def _have_room(axis_line, subs: Sequence[float], text: Callable[[float], str]) -> bool:
    """Whether numbers below an axis are two letters apart, with ticks at `subs` of a decade."""
    low, high = axis_line.get_view_interval()
    letter = LETTER * axis_line.axes.figure.dpi / 72 / axis_line.axes.bbox.width * math.log(high / low)
    return all(
        math.log(after / before) > letter * (2 + (len(text(before)) + len(text(after))) / 2)
        for before, after in itertools.pairwise(_ticks(axis_line, subs))
    )


def _ticks(axis_line, subs: Sequence[float]) -> list[float]:
    low, high = axis_line.get_view_interval()
    return [v for v in LogLocator(subs=subs).tick_values(low, high) if low <= v <= high]
