"""Whether error bounds held, of rows that say so by hand."""

import numpy as np
import pandas as pd
import pytest

from nsf.results.charts import View
from nsf.results.charts.bounds import error_bounds, promise

ROWS = pd.DataFrame(
    {
        "body": ["sand"] * 4 + ["cake"] * 4,
        "model_name": "projected",
        "displacement_error": [0.01, 0.02, 0.03, 0.3, 0.25, 0.04, np.inf, 0.01],
        "error_bound": [0.02, 0.03, 0.02, 0.1, 0.5, 0.4, np.inf, 0.5],
        "flag": ["green", "green", "green", "green", "red", "red", "red", "red"],
        "fallback_share": [0.0] * 7 + [1.0],
        "beyond": [0, 0, 0, 1, 0, 0, 0, 0],
    }
)


def test_coverage_sharpness_and_flags():
    sand, cake, every = promise(ROWS).to_dict("records")
    assert (sand["runs"], cake["runs"], every["runs"]) == (4, 3, 7)  # the fallback took one
    assert sand["holds"] == pytest.approx(2 / 3)  # a run beyond what was taught has no promise
    assert sand["sharpness"] == pytest.approx(np.median([2.0, 1.5, 2 / 3, 1 / 3]))
    assert (sand["missed"], sand["false_alarms"]) == (1.0, 0.0)
    assert (cake["holds"], cake["missed"], cake["false_alarms"]) == (1.0, 0.0, 1.0)
    assert every["missed"] == pytest.approx(1 / 3)
    assert 0.0 < every["rank"] < 1.0


def test_the_chart_has_a_dot_a_run():
    figure = error_bounds(View(ROWS))["error-bounds"]
    of_bodies = [panel for panel in figure.axes if panel.get_xlabel().startswith("error bound")]
    drawn = [line for panel in of_bodies for line in panel.lines[:-1]]
    assert sum(len(line.get_xdata()) for line in drawn) == 6  # a lost run has no place
    assert error_bounds(View(ROWS[:1])) == {}
