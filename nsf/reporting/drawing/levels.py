"""Who took the steps of a run, and its error meanwhile."""

import textwrap
from collections.abc import Mapping

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from nsf.results.scales import LOST, plain_ticks
from nsf.results.style import DASHES, FULL, INK, PALETTE, figure, styled

_LINE = 34  # letters of a name in a line

#: Title and colour of each level, in the order of `by`.
LEVELS = {"operators": PALETTE[0], "projected step": PALETTE[1], "full-order solver": FULL}


def name_of(series: pd.DataFrame) -> str:
    """What a run is called by those who took its steps."""
    names = [title for i, title in enumerate(LEVELS) if (series["by"] == i).any()]
    return f"{names[0]} alone" if len(names) == 1 else " and ".join(names)


def levels_over_time(runs: Mapping[str, pd.DataFrame]) -> Figure:
    """Displacement error [%] of runs of one parameter value over time [s], and a strip for each of who steps.

    Args:
        runs: by name, rows of `series.csv` of one run, `by` among them.
    """
    runs = {textwrap.fill(name, _LINE, break_on_hyphens=False): series for name, series in runs.items()}
    with styled():
        fig = figure(3.6 + 0.3 * len(runs))
        error, strips = fig.subplots(2, 1, sharex=True, height_ratios=[3.0, 0.36 * len(runs)])
        for i, (name, series) in enumerate(runs.items()):
            alone = [color for k, color in enumerate(LEVELS.values()) if (series["by"].dropna() == k).all()]
            own = alone[0] if alone else INK
            alike = [line.get_color() for line in error.lines].count(own)
            style = {"color": own, "linestyle": DASHES[alike % len(DASHES)]}
            error.plot(series["t"], 100 * series["displacement_error"], label=name, **style)
            taken = series["by"].notna().to_numpy()
            ends, by = series["t"].to_numpy()[taken], series["by"].to_numpy()[taken].astype(int)
            starts = np.append(series["t"].iloc[0], ends[:-1])
            for level, color in enumerate(LEVELS.values()):
                here = by == level
                spans = list(zip(starts[here], (ends - starts)[here], strict=True))
                strips.broken_barh(spans, (i - 0.36, 0.72), color=color, lw=0)
        error.set(ylabel="displacement error [%]", yscale="log")
        error.set_ylim(top=min(error.get_ylim()[1], LOST))
        plain_ticks(error.yaxis)
        error.grid(axis="y")
        strips.set_yticks(range(len(runs)), list(runs))
        strips.set(xlabel="time t [s]", ylim=(len(runs) - 0.5, -0.5))
        strips.tick_params(axis="y", length=0)
        shown = sorted({int(level) for series in runs.values() for level in series["by"].dropna()})
        known = [(title, color) for i, (title, color) in enumerate(LEVELS.items()) if i in shown]
        patches = [strips.fill_between([], [], color=color, label=title) for title, color in known]
        # Lines have a legend where colours do not say whose they are: above, where no line strikes it.
        colors = [line.get_color() for line in error.lines]
        lines = [line for line, c in zip(error.lines, colors, strict=True) if c == INK or colors.count(c) > 1]
        fig.legend(handles=[*patches, *lines], loc="outside upper left", ncols=3)
    return fig
