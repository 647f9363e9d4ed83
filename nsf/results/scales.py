"""Logarithmic axes with plain numbers, which stand apart."""

import itertools
import math
from collections.abc import Callable, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from nsf.results.style import LETTER

LOST = 1000.0  # [%] error from which a run is lost, by how much tells nothing: axes end there


def error_scale(panel, values, along: str = "y") -> None:
    """Logarithmic once the errors span more than a factor of 30, else linear from zero; to `LOST` at most."""
    values = np.asarray(values, float)
    values = np.minimum(values[np.isfinite(values) & (values > 0)], LOST)
    panel.grid(axis=along)
    limits = (0, 1.08 * np.max(values, initial=1e-12))
    logarithmic = len(values) > 0 and np.max(values) > 30 * np.quantile(values, 0.05)
    if logarithmic:
        panel.set(**{f"{along}scale": "log"})
        limits = (np.quantile(values, 0.02) / 1.6, np.max(values) * 1.6)
    panel.set(**{f"{along}lim": limits})
    if logarithmic:
        plain_ticks(getattr(panel, f"{along}axis"))


def plain_ticks(axis_line, text: Callable[[float], str] = "{:g}".format) -> None:
    """Give a logarithmic axis ticks as plain numbers, or as `text` says: at 1, 2 and 5 of a decade.

    At more of it where the axis spans less than a factor of 4, at 1 alone from three decades on.
    """
    low, high = axis_line.get_view_interval()
    few = (1, 2, 5) if high < 1e3 * low else (1,)
    subs = (1, 1.2, 1.5, 2, 2.5, 3, 4, 5, 6, 8) if high < 4 * low else few
    axis_line.set_major_locator(LogLocator(subs=subs))
    axis_line.set_major_formatter(FuncFormatter(lambda v, _: text(v)))
    axis_line.set_minor_formatter(NullFormatter())


def set_apart(fig: Figure) -> None:
    """Leave fewer plain ticks below logarithmic axes where their numbers would touch, but two at least.

    For last: it lays the figure out, since labels beside a panel take of its width.
    """
    fig.get_layout_engine().execute(fig)
    for panel in fig.axes:
        line = panel.xaxis
        if isinstance(line.get_major_locator(), LogLocator):
            sparser = (LogLocator(subs=subs) for subs in ((1, 2, 5), (1, 3), (1,)))
            for locator in itertools.chain([line.get_major_locator()], sparser):
                if len(ticks := _ticks(panel, locator)) < 2:
                    break
                line.set_major_locator(locator)
                if _have_room(panel, ticks):
                    break


def _have_room(panel: Axes, ticks: Sequence[float]) -> bool:
    """Whether the numbers of ticks below a panel are two letters apart."""
    low, high = panel.get_xlim()
    letter = LETTER * panel.figure.dpi / 72 / panel.bbox.width * math.log(high / low)
    lengths = [len(panel.xaxis.get_major_formatter()(tick)) for tick in ticks]
    return all(
        math.log(after / before) > letter * (2 + (a + b) / 2)
        for (before, a), (after, b) in itertools.pairwise(zip(ticks, lengths, strict=True))
    )


def _ticks(panel: Axes, locator: LogLocator) -> list[float]:
    low, high = panel.get_xlim()
    return [v for v in locator.tick_values(low, high) if low <= v <= high]
