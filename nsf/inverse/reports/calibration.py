"""One calibration: the estimate, how sure it is, the residuals, and a full-order run at the estimate."""

from collections.abc import Callable

import numpy as np
import pandas as pd
import torch

from nsf.data import Trajectory
from nsf.deployment.trust import bound_text, percent
from nsf.inverse.fit import CONFIDENCE, Fit, fit
from nsf.inverse.model import Model
from nsf.inverse.observations import AXES, Observations, View
from nsf.inverse.reports.charts import points_chart, residuals_chart
from nsf.inverse.reports.page import Chart, Problem, Results, frame_table, named, rms, title_of
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
    (
        "error bound",
        "of the displacement error of the run, as validation runs show it (docs/method.md, Trust).",
    ),
)
_POINTS = "Observed and fitted points at the last time that was observed."
_RESIDUALS = "Observations less runs over time; the full-order run is at the estimate."


def calibration(
    problem: Problem,
    view: View,
    space: Space,
    full_order: bool = True,
    starts: int = 64,
    say: Callable[[str], object] = print,
) -> Results:
    """Calibrate, and run the full-order solver at the estimate.

    Args:
        problem: the model, and the program that the observed run followed.
        view: of the observations.
        space: where to look.
        full_order: whether to make that run.
        starts: see `fit`.
        say: called with a line of what is done.

    Returns:
        A page with `estimate.csv`, `correlation.csv` and `residuals.csv`.
    """
    model, runs = problem.model, []
    best = fit(view, model, space, starts=starts, forcing=problem.forcing)
    values = zip(space.free, best.estimate, best.standard_error, strict=True)
    words = [f"{named(model, name)} {value:.4g} ± {error:.2g}" for name, value, error in values]
    say(f"calibrate: {', '.join(words)} in {best.seconds:.2f} s")
    rows = view.observations.frame.assign(fitted=best.seen, s=best.scale, residual=-best.residuals)
    if full_order:
        estimate = dict(zip(space.free, best.estimate.tolist(), strict=True))
        runs = problem.full_order([estimate | dict(space.fixed)])
        with Trajectory.of(runs[0]) as truth:
            rows["full_order"] = view.of_truth(truth)
        off = 1e3 * rms(rows["value"] - rows["full_order"])
        say(f"calibrate: a full-order run at the estimate leaves {off:.3g} mm (RMS) → {runs[0].id}")
    estimate, correlation = _estimate(best, model), pd.DataFrame(best.correlation, columns=list(space.free))
    correlation.insert(0, "parameter", space.free)
    return Results(
        title=f"{title_of(model)}: calibration",
        lead=_LEAD,
        models=[model],
        runs=runs,
        tables=_tables(best, estimate, correlation, rows),
        files={"estimate.csv": estimate, "correlation.csv": correlation, "residuals.csv": rows},
        charts=[
            *([_points(model, best, rows)] if rows["what"].isin(AXES).any() else []),
            Chart("Observed and fitted", "residuals", _RESIDUALS, residuals_chart(rows)),
        ],
        facts=[
            ("Error bound of the fitted run", percent(best.error_bound)),
            ("Seconds", number(best.seconds)),
        ],
        definitions=_TERMS,
        warnings=warnings_of(best, view.observations),
        settings={
            "ranges": dict(zip(space.free, space.ranges.tolist(), strict=True)),
            "fixed": dict(space.fixed),
        },
    )


def warnings_of(best: Fit, observations: Observations) -> list[str]:
    """Sentences that a reader must know before they use an estimate."""
    warnings = [
        f"{name} ends at an end of its range, and the truth may lie beyond; train with a wider range"
        for name in best.at_end
    ]
    if best.misfit > _MISFIT:
        k = int(np.abs(best.residuals).argmax())
        warnings.append(
            f"no run passes the observations: the best misses them by {best.misfit:.3g} deviations (RMS), "
            f"the model's own error among these, {observations.place(k)} by {abs(best.residuals[k]):.3g}; "
            "look for a wrong unit, point or time"
        )
    if best.error_bound > best.limit:
        warnings.append(f"the fitted run is not to be believed: {bound_text(best.error_bound, best.limit)}")
    return warnings


def _estimate(best: Fit, model: Model) -> pd.DataFrame:
    """A row a parameter."""
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
            "error_bound": best.error_bound,
        }
    )


def _tables(best: Fit, estimate: pd.DataFrame, correlation: pd.DataFrame, rows: pd.DataFrame) -> list:
    """Tables of the page: the estimate, the correlation of several parameters, and the residuals."""
    value, lower, upper, fitted = (
        estimate[name].map("{:.5g}".format) for name in ("estimate", "lower_90", "upper_90", "fitted")
    )
    shown = {
        "parameter": [named(best.space.model, name) for name in estimate["parameter"]],
        "estimate": value,
        "standard error": estimate["standard_error"],
        "90 % interval": lower + " … " + upper,
        "the model's own [%]": 100 * estimate["share_of_model"],
        "fits best": fitted,
    }
    left = {
        "deviation of the measurement": rows["deviation"],
        "the model's own error, expected": np.sqrt(np.maximum(rows["s"] ** 2 - rows["deviation"] ** 2, 0.0)),
        "observed less the fitted run": rows["value"] - rows["fitted"],
    }
    if "full_order" in rows:
        left["observed less the full-order run at the estimate"] = rows["value"] - rows["full_order"]
    errors = pd.DataFrame({"": list(left), "RMS [mm]": [1e3 * rms(off) for off in left.values()]})
    tables = [frame_table("Estimate", pd.DataFrame(shown), f"{len(rows)} observations.")]
    if len(estimate) > 1:
        tables.append(frame_table("Correlation of the errors", correlation.rename(columns={"parameter": ""})))
    return [*tables, frame_table("Residuals", errors, "Root mean squares over the observations.")]


def _points(model: Model, best: Fit, rows: pd.DataFrame) -> Chart:
    """Points at the last time that was observed, in the body of the fitted run."""
    rows = rows[rows["what"].isin(AXES)]
    t = float(rows["t"].max())
    wide = rows[rows["t"] == t].pivot_table(index=["X", "Y", "Z"], columns="what", values=["value", "fitted"])
    observed, fitted = (wide[kind].reindex(columns=AXES).to_numpy() for kind in ("value", "fitted"))
    frame = torch.as_tensor(best.xhat[round(t / model.dt)], device=model.device)
    body = model.positions(frame, np.arange(len(model.manifold.X))).cpu().numpy()
    return Chart("Observed and fitted", "points", _POINTS, points_chart(body, observed, fitted, t))
