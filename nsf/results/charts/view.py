"""A report as charts see it, and the register of charts."""

import functools
import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import pandas as pd
from matplotlib.figure import Figure

from nsf.results.averages import means
from nsf.results.formats import file_name
from nsf.results.style import styled

Figures = Mapping[str, Figure]


@dataclass(frozen=True)
class View:
    """A report as charts see it.

    Attributes:
        frame: its rows, as `nsf.results.table.labelled` gives them.
        series: errors and latent coordinates, a row a frame, with `body`, `variant` and `case`; None where
            the runs are not there.
        stages: time of a step by stage [ms], of each variant by "body · variant", and of the full-order
            step under "full order".
        trained: the training cases of each scene, a mapping from parameter to value.
        logarithmic: names of parameters whose design is logarithmic.
    """

    frame: pd.DataFrame
    series: pd.DataFrame | None = None
    stages: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    trained: Mapping[str, Sequence[Mapping[str, float]]] = field(default_factory=dict)
    logarithmic: frozenset[str] = frozenset()

    @cached_property
    def averages(self) -> pd.DataFrame:
        """A row a body and variant, with means over cases and seeds."""
        return means(self.frame)


@dataclass(frozen=True)
class Chart:
    """A chart: the function that draws it, and the caption of its figures."""

    draw: Callable[[View], Figures]
    caption: str


CHARTS: dict[str, Chart] = {}
"""Every chart by its name, in the order in which a page shows them."""


def chart(caption: str) -> Callable[[Callable[[View], Figures]], Callable[[View], Figures]]:
    """Register a function of a `View` as a chart under its own name; it draws in the style of all charts."""

    def register(draw: Callable[[View], Figures]) -> Callable[[View], Figures]:
        @functools.wraps(draw)
        def drawn(view: View) -> Figures:
            with styled():
                return draw(view)

        CHARTS[draw.__name__] = Chart(drawn, caption)
        return drawn

    return register


def best(frame: pd.DataFrame) -> Iterator[tuple[str, str, str]]:
    """File stem, body and variant of the best variant of each body and model: all would drown a page.

    One whose steps another model took stands last.
    """
    averages = means(frame)
    averages["rank"] = averages["delta"].where(averages["fallback_share"].fillna(0) < 1, math.inf)
    chosen = averages.sort_values("rank", kind="stable").groupby(["body", "model_name"], sort=False).head(1)
    chosen = averages.loc[sorted(chosen.index)]
    for row in chosen.to_dict("records"):
        several = (chosen["body"].nunique() > 1, (chosen["body"] == row["body"]).sum() > 1)
        parts = [row["body"] if several[0] else "", row["model_name"] if several[1] else ""]
        stem = "".join(f"{file_name(re.sub(r'[ ,=()·]+', '-', part)).strip('-')}-" for part in parts if part)
        yield stem, row["body"], row["variant"]


def best_series(view: View) -> Iterator[tuple[str, pd.DataFrame]]:
    """The series of the best variant of each body and model, of the first seed, by file stem."""
    if view.series is None:
        return
    for stem, body, variant in best(view.frame):
        rows = view.series[(view.series["body"] == body) & (view.series["variant"] == variant)]
        if not rows.empty:
            yield stem, rows[rows["run"] == rows["run"].iloc[0]]
