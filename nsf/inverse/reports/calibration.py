"""One calibration: the estimate, how sure it is, what is left, and a full-order run there."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from matplotlib.figure import Figure

from nsf.data import PROGRAM, Trajectory
from nsf.data.schema import TRAJECTORY
from nsf.inverse.fit import CONFIDENCE, Fit, fit
from nsf.inverse.model import Model
from nsf.inverse.observations import AXES, Observations, View
from nsf.inverse.reports.charts import points_chart, residuals_chart
from nsf.inverse.reports.page import Chart, Results, frame_table, named, rms, title_of, write
from nsf.inverse.space import Space
from nsf.results.columns import number

_LEAD = (
    "The parameters under which runs by recurrence pass what was observed, with the uncertainty that the "
    "measurement and the reduced model's own error leave."
)
#: Deviations (RMS) beyond which the observations count as missed.
_MISFIT = 3.0
_TERMS = (
    ("estimate", "the parameters that fit best, less what validation runs near them are off on average."),
    ("standard error", "of the estimate: of the measurement, and of the reduced model's own error."),
    ("interval", f"holds the truth in {100 * CONFIDENCE:g} % of the cases (Student's)."),
    ("the model's own", "share of the standard error's square that is the reduced model's own error."),
    (
        "residual",
        "observed less seen in a run, over s, where s² is the square of the deviation and the model's.",
    ),
    ("distrust", "how far the fitted run is from what was taught; above 1 it is not to be believed."),
)
_POINTS = "Observed and fitted points at the last time that was observed."
_RESIDUALS = "Observations less runs over time; the full-order run is at the estimate."


def report(
    view: View,
    model: Model,
    space: Space,
    folder: Path,
    *,
    program: int | None = None,
    full_order: bool = True,
    starts: int = 64,
    say: Callable[[str], object] = print,
) -> tuple[Path, Fit]:
    """Calibrate, run the full-order solver at the estimate, and write the results.

    Args:
        view: of the observations.
        model, space: of the runs, and where to look.
        folder: of the page, `estimate.csv`, `correlation.csv` and `residuals.csv`.
        program: number of the program that the observed run followed, where the scene has programs.
        full_order: whether to make that run.
        starts: see `fit`.
        say: told what is done.
    """
    forcing = None if program is None else model.forcing(program=program)
    best = fit(view, model, space, starts=starts, forcing=forcing)
    estimate = _estimate(best, model)
    values = zip(best.estimate, best.standard_error, strict=True)
    words = [f"{named(model, n)} {v:.4g} ± {e:.2g}" for n, (v, e) in zip(space.free, values, strict=True)]
    say(f"calibrate: {', '.join(words)} in {best.seconds:.2f} s")
    rows = view.observations.frame.assign(fitted=best.seen, s=best.scale, residual=-best.residuals)
    runs = []
    if full_order:
        known = dict(zip(space.free, best.estimate.tolist(), strict=True)) | dict(space.fixed)
        case = model.scene.case(known if program is None else known | {PROGRAM: program})
        runs = model.pipeline.full_order([case])
        with Trajectory.open(runs[0].file(TRAJECTORY)) as truth:
            rows["full_order"] = view.of_truth(truth)
        off = 1e3 * rms(rows["value"] - rows["full_order"])
        say(f"calibrate: a full-order run at the estimate leaves {off:.3g} mm (RMS) → {runs[0].id}")
    warnings = warnings_of(best, view.observations)
    for warning in warnings:
        say(f"calibrate: warning: {warning}")
    correlation = pd.DataFrame(best.correlation, columns=list(space.free))
    correlation.insert(0, "parameter", space.free)
    stops = f"the best of {best.starts} starts were followed to their ends: {'; '.join(best.stops)}."
    tables = [frame_table("Estimate", _shown(estimate, model), f"{len(rows)} observations; {stops}")]
    if len(space.free) > 1:
        tables.append(frame_table("Correlation of the errors", correlation.rename(columns={"parameter": ""})))
    tables.append(frame_table("What is left", _left(rows), "Root mean squares over the observations."))
    charts = [Chart("Observed and fitted", "residuals", _RESIDUALS, lambda: residuals_chart(rows))]
    if rows["what"].isin(AXES).any():
        chart = Chart("Observed and fitted", "points", _POINTS, lambda: _points(model, best, rows))
        charts.insert(0, chart)
    results = Results(
        title=f"{title_of(model)}: calibration",
        lead=_LEAD,
        models=[model],
        beside=runs,
        tables=tables,
        files={"estimate.csv": estimate, "correlation.csv": correlation, "residuals.csv": rows},
        charts=charts,
        facts=[("Distrust of the fitted run", number(best.distrust)), ("Seconds", number(best.seconds))],
        definitions=_TERMS,
        warnings=warnings,
        asked={
            "ranges": dict(zip(space.free, space.ranges.tolist(), strict=True)),
            "fixed": dict(space.fixed),
        },
    )
    return write(results, folder), best


def warnings_of(best: Fit, own: Observations) -> list[str]:
    """What a reader must know of an estimate before they use it."""
    warnings = [
        f"{name} ends at an end of its range, and the truth may lie beyond; train with a wider range"
        for name in best.at_end
    ]
    if best.misfit > _MISFIT:
        k = int(np.abs(best.residuals).argmax())
        warnings.append(
            f"no run passes the observations: the best misses them by {best.misfit:.3g} deviations (RMS), "
            f"the model's own error among these, {own.place(k)} by {abs(best.residuals[k]):.3g}; look for "
            "a wrong unit, point or time"
        )
    if best.distrust > 1.0:
        warnings.append(
            f"the fitted run is {best.distrust:.3g} times as far from what was taught as may be believed"
        )
    return warnings


def _estimate(best: Fit, model: Model) -> pd.DataFrame:
    units = dict(zip(model.names, model.units, strict=True))
    return pd.DataFrame(
        {
            "parameter": best.space.free,
            "unit": [units[name] for name in best.space.free],
            "estimate": best.estimate,
            "standard_error": best.standard_error,
            "lower_90": best.lower,
            "upper_90": best.upper,
            "fitted": best.fitted,
            "share_of_model": best.share,
            "degrees_of_freedom": best.freedom,
            "distrust": best.distrust,
        }
    )


def _shown(estimate: pd.DataFrame, model: Model) -> pd.DataFrame:
    lower, upper = (estimate[f"{end}_90"].map("{:.5g}".format) for end in ("lower", "upper"))
    return pd.DataFrame(
        {
            "parameter": [named(model, name) for name in estimate["parameter"]],
            "estimate": estimate["estimate"].map("{:.5g}".format),
            "standard error": estimate["standard_error"],
            "90 % interval": lower + " … " + upper,
            "the model's own [%]": 100 * estimate["share_of_model"],
            "fits best": estimate["fitted"].map("{:.5g}".format),
        }
    )


def _left(rows: pd.DataFrame) -> pd.DataFrame:
    own = np.sqrt(np.maximum(rows["s"] ** 2 - rows["deviation"] ** 2, 0.0))
    left = {
        "deviation of the measurement": rows["deviation"],
        "the model's own error, expected": own,
        "observed less the fitted run": rows["value"] - rows["fitted"],
    }
    if "full_order" in rows:
        left["observed less the full-order run at the estimate"] = rows["value"] - rows["full_order"]
    return pd.DataFrame({"": list(left), "RMS [mm]": [1e3 * rms(values) for values in left.values()]})


def _points(model: Model, best: Fit, rows: pd.DataFrame) -> Figure:
    """Points at the last time that was observed, in the body of the fitted run."""
    rows = rows[rows["what"].isin(AXES)]
    t = float(rows["t"].max())
    wide = rows[rows["t"] == t].pivot_table(index=["X", "Y", "Z"], columns="what", values=["value", "fitted"])
    observed, fitted = (wide[kind].reindex(columns=AXES).to_numpy() for kind in ("value", "fitted"))
    frame = torch.as_tensor(best.xhat[round(t / model.dt)], device=model.device)
    body = model.positions(frame, np.arange(len(model.manifold.X))).cpu().numpy()
    return points_chart(body, observed, fitted, t)
