"""The runs of a chain as a notebook shows them."""

import base64
import io
import math
from collections.abc import Sequence

import pandas as pd

from nsf.bodies.colors import STRESS_COLORS
from nsf.results import pictures
from nsf.results.averages import rows_of
from nsf.results.sources import Source
from nsf.results.style import PIXELS, write_png
from nsf.results.table import labelled
from nsf.runs import Run

_EACH = (
    "case",
    "displacement_error",
    "stress_error",
    "delta",
    "error_bound",
    "flag",
    "step_ms_full",
    "step_ms",
)


def html(runs: Sequence[Run]) -> str:
    """A table of runs; of those evaluated also errors and times of each case, and a strip of the worst."""
    listed = pd.DataFrame([(run.id, run.status) for run in runs], columns=["run", "status"])
    evaluated = [Source(run) for run in runs if run.stage == "evaluate" and run.complete]
    return listed.to_html(index=False) + "".join(map(_of_evaluation, evaluated))


def _of_evaluation(source: Source) -> str:
    frame = labelled(source.rows.assign(run=source.id, setting="", paper_delta=math.nan))
    rows = rows_of(frame, _EACH)
    errors = pd.DataFrame(rows.body, columns=rows.headings).to_html(index=False)
    worst = pictures.cases(frame, frame.iloc[:0], {source.id: source}, 1)
    if not worst:
        return errors
    drawn = io.BytesIO()
    write_png(pictures.strip(worst), drawn, PIXELS, [STRESS_COLORS])
    return f'{errors}<img src="data:image/png;base64,{base64.b64encode(drawn.getvalue()).decode()}">'
