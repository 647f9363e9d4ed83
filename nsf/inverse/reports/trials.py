"""The report of synthetic trials: how near estimates come, and how often their intervals hold the truth."""

from collections.abc import Callable, Sequence

import numpy as np
import pandas as pd

from nsf.inverse.fit import CONFIDENCE, Fit
from nsf.inverse.model import Model
from nsf.inverse.reports.charts import trials_chart
from nsf.inverse.reports.page import Chart, Results, frame_table, named
from nsf.inverse.trials import Trials, run

_TERMS = (
    ("trial", "a full-order run at held-out parameters, observed with noise, calibrated as if unknown."),
    ("off", "the estimate less the truth, in the parameter's unit."),
    ("intervals that hold", "share of the 90 % intervals that have the truth inside."),
    ("the model's own", "share of the standard error's square that is the reduced model's own error."),
    ("calibration", "median wall time of one, the model's own error included; the model is loaded."),
    ("distrusted", "trials whose fitted run is not to be believed: its error bound passes trust.limit."),
)
_LEAD = (
    "How near do parameters come that are estimated from a few noisy points of a full-order run at "
    f"held-out values, and how often do the stated {100 * CONFIDENCE:g} % intervals hold the truth?"
)
_CHART = "What each estimate is off over the truth, with its 90 % interval; a panel a scene and parameter."


def trying(models: Sequence[Model], trials: Trials, say: Callable[[str], object] = print) -> Results:
    """Make trials of each model.

    Args:
        models: of different scenes.
        trials: how they are made.
        say: called with a line of each trial.

    Returns:
        A page with `results.csv`.
    """
    made = [run(model, trials, say) for model in models]
    table = pd.concat([rows for rows, _ in made], ignore_index=True)
    fits = [fit for _, fits in made for fit in fits]
    ends = {end: np.concatenate([getattr(fit, end) for fit in fits]) for end in ("lower", "upper")}
    units = {(m.scene.name, p): u for m in models for p, u in zip(m.names, m.units, strict=True)}
    settings = (
        f"{trials.points} points at {trials.times} times, noise of {1e3 * trials.deviation:g} mm on each "
        f"component, seed {trials.seed}"
    )
    pairs = zip(models, made, strict=True)
    summary = pd.DataFrame([row for model, results in pairs for row in _rows(model, *results)])
    return Results(
        title="Calibration",
        lead=_LEAD,
        models=models,
        tables=[frame_table("Trials", summary, f"{trials.count} trials a scene: {settings}.", text=3)],
        files={"results.csv": table},
        charts=[Chart("Trials", "trials", _CHART, trials_chart(table.assign(**ends), units))],
        facts=[("Observed", settings)],
        definitions=_TERMS,
        settings=vars(trials),
    )


def _rows(model: Model, table: pd.DataFrame, fits: Sequence[Fit]) -> list[dict]:
    """A row a parameter of one scene."""
    rows = []
    for k, name in enumerate(model.names):
        part, (low, high) = table[table["parameter"] == name], model.ranges[k]
        off = (part["estimate"] - part["truth"]).abs()
        rows.append({
            "scene": model.scene.name,
            "parameter": named(model, name),
            "range": f"{low:g} … {high:g}",
            "trials": len(part),
            "median |off|": off.median(),
            "largest |off|": off.max(),
            "median |off| [% of range]": 100 * off.median() / (high - low),
            "intervals that hold [%]": 100 * part["inside_90"].mean(),
            "median standard error": part["standard_error"].median(),
            "of it the model's own [%]": 100 * float(np.median([fit.share[k] for fit in fits])),
            "calibration [s]": part["seconds"].median(),
            "distrusted": sum(fit.error_bound > fit.limit for fit in fits),
        })  # fmt: skip
    return rows
