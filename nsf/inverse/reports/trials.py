"""The report of synthetic trials: how near estimates come, and how often their intervals hold the truth."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from nsf.inverse.fit import CONFIDENCE, Fit
from nsf.inverse.model import Model
from nsf.inverse.reports.charts import trials_chart
from nsf.inverse.reports.page import Results, write
from nsf.inverse.trials import Trials, run
from nsf.reporting.text.columns import axis, number
from nsf.results.formats import Rows
from nsf.results.page import Picture, Section, Table
from nsf.results.style import save

_HEADINGS = (
    "scene", "parameter", "range", "trials", "median |off|", "largest |off|", "median |off| [% of range]",
    "intervals that hold [%]", "median standard error", "of it the model's own [%]", "calibration [s]",
    "distrusted",
)  # fmt: skip
_TERMS = (
    ("trial", "a full-order run at held-out parameters, observed with noise, calibrated as if unknown."),
    ("off", "the estimate less the truth, in the parameter's unit."),
    ("intervals that hold", "share of the 90 % intervals that have the truth inside."),
    ("the model's own", "share of the standard error's square that is the reduced model's own error."),
    ("calibration", "median wall time of one, the model's own error included; the model is loaded."),
    ("distrusted", "trials whose fitted run is not to be believed (distrust ratio above 1)."),
)


def report(
    models: Sequence[Model], trials: Trials, folder: Path, say: Callable[[str], object] = print
) -> Path:
    """Make trials of each model, and write their report.

    Args:
        models: of different scenes.
        trials: how they are made.
        folder: of the report.
        say: told of each trial.

    Returns:
        The path of `index.html`.
    """
    made = [run(model, trials, say) for model in models]
    table = pd.concat([rows for rows, _ in made], ignore_index=True)
    fits = [found for _, found in made]
    units = {(m.scene.name, p): u for m in models for p, u in zip(m.names, m.units, strict=True)}
    reach = np.concatenate([_reach(found) for found in fits])
    runs = [parent for model in models for parent in (model.run, *model.run.parent_runs)]

    def draw(fresh: Path) -> list[Section]:
        files = save(trials_chart(table, reach, units), fresh, "trials")
        told = (
            "What each estimate is off over the truth, with its 90 % interval; a panel a scene and parameter."
        )
        return [Section("Trials", [Picture(files, told, [model.run.id for model in models])])]

    settings = (
        f"{trials.points} points at {trials.times} times, noise of {1e3 * trials.deviation:g} mm on each "
        f"component, seed {trials.seed}"
    )
    results = Results(
        title="Calibration",
        lead=(
            "How near do parameters come that are estimated from a few noisy points of a full-order run at "
            f"held-out values, and how often do the stated {100 * CONFIDENCE:g} % intervals hold the truth?"
        ),
        tables=[
            Table("Trials", _summary(models, table, fits), f"{trials.count} trials a scene: {settings}.")
        ],
        files={"results.csv": table},
        runs=runs,
        draw=draw,
        facts=[("Observed", settings)],
        definitions=_TERMS,
        asked=vars(trials),
    )
    return write(results, folder)


def _reach(fits: Sequence[Fit]) -> np.ndarray:
    """[rows, 2] of the intervals below and above the estimates, in the order of the table."""
    return np.concatenate([np.stack([f.estimate - f.lower, f.upper - f.estimate], 1) for f in fits])


def _summary(models: Sequence[Model], table: pd.DataFrame, fits: Sequence[Sequence[Fit]]) -> Rows:
    body = []
    for model, found in zip(models, fits, strict=True):
        for k, name in enumerate(model.names):
            part = table[(table["scene"] == model.scene.name) & (table["parameter"] == name)]
            off, (low, high) = (part["estimate"] - part["truth"]).abs(), model.ranges[k]
            shown = axis(name.replace("_", " "), model.units[k])
            body.append(
                [
                    model.scene.name,
                    shown,
                    f"{low:g} … {high:g}",
                    str(len(part)),
                    number(off.median()),
                    number(off.max()),
                    number(100 * off.median() / (high - low)),
                    number(100 * part["inside_90"].mean()),
                    number(part["standard_error"].median()),
                    number(100 * float(np.median([fit.share[k] for fit in found]))),
                    number(part["seconds"].median()),
                    str(int((part["distrust"] > 1.0).sum())),
                ]
            )
    return Rows(list(_HEADINGS), body, [False, False, False] + [True] * (len(_HEADINGS) - 3))
