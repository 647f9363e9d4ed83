"""Synthetic trials: observations made by full-order runs, and how often intervals hold the truth."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd

from nsf.data import PROGRAM, Case, Trajectory
from nsf.inverse.fit import CONFIDENCE, Fit, fit
from nsf.inverse.model import Model
from nsf.inverse.observations import Observations, View
from nsf.inverse.reports.charts import trials_chart
from nsf.inverse.reports.page import Chart, Results, frame_table, named
from nsf.inverse.space import Space
from nsf.scenes.designs import random_cases

#: Columns of results.csv.
COLUMNS = (
    "scene", "parameter", "trial", "truth", "estimate", "standard_error", "inside_90", "seconds",
    "error_bound",
)  # fmt: skip
_SEED = 100  # of the cases, apart from those that teach a recurrence


@dataclass(frozen=True)
class Trials:
    """How trials are made.

    Attributes:
        count: how many.
        points, times: how many particles are observed, and at how many times, evenly up to the end.
        deviation: of the noise on each component [m].
        seed: of cases, points and noise.
    """

    count: int = 20
    points: int = 50
    times: int = 10
    deviation: float = 1e-3
    seed: int = 0

    def cases(self, model: Model) -> list[Case]:
        """The held-out cases: spread over the ranges, none of them one of the design."""
        split = model.pipeline.split
        return random_cases(split.box, self.count, _SEED + self.seed, list(split.cases))

    def observed(self, model: Model, truth: Trajectory, trial: int) -> Observations:
        """Observations of a full-order run, with noise."""
        generator = np.random.default_rng([self.seed, trial])
        X = model.manifold.X.cpu().numpy()
        points = X[np.sort(generator.choice(len(X), min(self.points, len(X)), replace=False))]
        t = model.t[-1] * np.arange(1, self.times + 1) / self.times
        none = np.zeros((self.times, len(points), 3))
        exact = Observations.of_points(t, points, none, self.deviation)
        values = View(exact, model).of_truth(truth)
        return replace(exact, values=values + self.deviation * generator.standard_normal(len(values)))


def run(model: Model, trials: Trials, say: Callable[[str], object] = print) -> tuple[pd.DataFrame, list[Fit]]:
    """Calibrate each trial as if nothing were known of it.

    Args:
        model: of the runs.
        trials: how they are made.
        say: called with a line of each trial.

    Returns:
        One row a trial and parameter, with `COLUMNS`: `inside_90` is 1 where the 90 % interval holds the
        truth, `seconds` what the calibration took, the model's own error included; and the fits.
    """
    cases = trials.cases(model)
    say(f"calibrate: full-order runs of {len(cases)} trials of {model.scene.name}")
    runs, rows, fits = model.pipeline.full_order(cases), [], []
    for trial, (case, simulated) in enumerate(zip(cases, runs, strict=True)):
        with Trajectory.of(simulated) as truth:
            seen = trials.observed(model, truth, trial)
        began = time.perf_counter()
        forcing = model.forcing(case.parameters, int(case[PROGRAM])) if PROGRAM in case else None
        best = fit(View(seen, model), model, Space.of(model), forcing=forcing)
        seconds = time.perf_counter() - began
        fits.append(best)
        for k, name in enumerate(best.space.free):
            inside = best.lower[k] <= case[name] <= best.upper[k]
            values = case[name], best.estimate[k], best.standard_error[k], int(inside), seconds
            rows.append([model.scene.name, name, trial, *values, best.error_bound])
        text = ", ".join(
            f"{name} {best.estimate[k]:.4g} ± {best.standard_error[k]:.2g} for {case[name]:.4g}"
            for k, name in enumerate(best.space.free)
        )
        say(f"calibrate: trial {trial}: {text}, {seconds:.2f} s")
    return pd.DataFrame(rows, columns=list(COLUMNS)), fits


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
