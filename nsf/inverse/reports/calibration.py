"""One calibration: the estimate, how sure it is, what is left, and a full-order run there."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import torch

from nsf.data import PROGRAM, Trajectory
from nsf.data.schema import TRAJECTORY
from nsf.inverse.fit import CONFIDENCE, Fit, fit
from nsf.inverse.model import Model
from nsf.inverse.observations import AXES, Observations, View
from nsf.inverse.reports.charts import points_chart, residuals_chart
from nsf.inverse.reports.page import Results, write
from nsf.inverse.space import Space
from nsf.reporting.text.columns import axis, number
from nsf.results.formats import Rows
from nsf.results.page import Picture, Section, Table
from nsf.results.style import save

_LEAD = (
    "The parameters under which runs by operators pass what was observed, with the uncertainty that the "
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
    """Calibrate, run the full-order solver at the estimate, and write what came out.

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
    found = fit(view, model, space, starts=starts, forcing=forcing)
    say(f"calibrate: {_told(found, model)} in {found.seconds:.2f} s")
    rows, warnings = _residuals(view, found), warnings_of(found, view.observations)
    runs = [model.run, *model.run.parent_runs]
    if full_order:
        values = dict(zip(space.free, found.estimate.tolist(), strict=True)) | dict(space.fixed)
        case = model.scene.case(values if program is None else values | {PROGRAM: program})
        (run,) = model.pipeline.full_order([case])
        with Trajectory.open(run.file(TRAJECTORY)) as truth:
            rows["full_order"] = view.of_truth(truth)
        runs.append(run)
        rms = 1e3 * float(np.sqrt(np.mean((rows["value"] - rows["full_order"]) ** 2)))
        say(f"calibrate: a full-order run at the estimate leaves {rms:.3g} mm (RMS) → {run.id}")
    estimate = _estimate(found, model)
    correlation = pd.DataFrame(found.correlation, columns=list(space.free))
    correlation.insert(0, "parameter", space.free)

    def draw(fresh: Path) -> list[Section]:
        return [Section("Observed and fitted", _pictures(view, model, found, rows, fresh))]

    tables = [Table("Estimate", _rows(found, model), f"{len(rows)} observations; {_stops(found)}")]
    if len(space.free) > 1:
        body = [[n, *map(number, row)] for n, row in zip(space.free, found.correlation.tolist(), strict=True)]
        heads = ["", *space.free]
        own = Rows(heads, body, [False] + [True] * len(space.free))
        tables.append(Table("Correlation of the errors", own, ""))
    tables.append(Table("What is left", _left(rows, found), "Root mean squares over the observations."))
    title = model.scene.config.scene.get("title") or model.scene.name
    results = Results(
        title=f"{title}: calibration",
        lead=_LEAD,
        tables=tables,
        files={"estimate.csv": estimate, "correlation.csv": correlation, "residuals.csv": rows},
        runs=runs,
        draw=draw,
        facts=[("Distrust of the fitted run", number(found.distrust)), ("Seconds", number(found.seconds))],
        definitions=_TERMS,
        warnings=warnings,
        asked={
            "ranges": dict(zip(space.free, space.ranges.tolist(), strict=True)),
            "fixed": dict(space.fixed),
        },
    )
    for warning in warnings:
        say(f"calibrate: warning: {warning}")
    return write(results, folder), found


def _told(found: Fit, model: Model) -> str:
    units = dict(zip(model.names, model.units, strict=True))
    parts = zip(found.space.free, found.estimate, found.standard_error, strict=True)
    return ", ".join(f"{axis(n, units[n])} {value:.4g} ± {error:.2g}" for n, value, error in parts)


def warnings_of(found: Fit, own: Observations) -> list[str]:
    """What a reader must know of an estimate before they use it."""
    told = [
        f"{name} ends at an end of its range, and the truth may lie beyond; train with a wider range"
        for name in found.at_end
    ]
    if found.misfit > _MISFIT:
        k = int(np.abs(found.residuals).argmax())
        told.append(
            f"no run passes the observations: the best misses them by {found.misfit:.3g} deviations (RMS), "
            f"the model's own error among these, {own.place(k)} by {abs(found.residuals[k]):.3g}; look for "
            "a wrong unit, point or time"
        )
    if found.distrust > 1.0:
        told.append(
            f"the fitted run is {found.distrust:.3g} times as far from what was taught as may be believed"
        )
    return told


def _estimate(found: Fit, model: Model) -> pd.DataFrame:
    units = dict(zip(model.names, model.units, strict=True))
    return pd.DataFrame(
        {
            "parameter": found.space.free,
            "unit": [units[name] for name in found.space.free],
            "estimate": found.estimate,
            "standard_error": found.standard_error,
            "lower_90": found.lower,
            "upper_90": found.upper,
            "fitted": found.fitted,
            "share_of_model": found.share,
            "degrees_of_freedom": found.freedom,
            "distrust": found.distrust,
        }
    )


def _rows(found: Fit, model: Model) -> Rows:
    heads = ["parameter", "estimate", "standard error", "90 % interval", "the model's own [%]", "fits best"]
    body = [
        [
            axis(row["parameter"].replace("_", " "), row["unit"]),
            f"{row['estimate']:.5g}",
            number(row["standard_error"]),
            f"{row['lower_90']:.5g} … {row['upper_90']:.5g}",
            number(100 * row["share_of_model"]),
            f"{row['fitted']:.5g}",
        ]
        for row in _estimate(found, model).to_dict("records")
    ]
    return Rows(heads, body, [False] + [True] * (len(heads) - 1))


def _stops(found: Fit) -> str:
    ends = "; ".join(found.stops)
    return f"the best of {found.starts} starts were followed to their ends: {ends}."


def _residuals(view: View, found: Fit) -> pd.DataFrame:
    """A row an observation: what, where, when, the value, its deviation, what the fitted run has [m]."""
    own = view.observations
    X = dict(zip(("X", "Y", "Z"), own.points.T, strict=True))
    values = {"value": own.values, "deviation": own.deviations, "fitted": found.seen}
    return pd.DataFrame(
        {"t": own.t, "what": own.what, **X, **values, "s": found.scale, "residual": -found.residuals}
    )


def _left(rows: pd.DataFrame, found: Fit) -> Rows:
    def rms(values) -> str:
        return number(1e3 * float(np.sqrt(np.mean(np.square(values)))))

    body = [["deviation of the measurement", rms(rows["deviation"])], ["the model's own error, expected", ""]]
    body[1][1] = rms(np.sqrt(np.maximum(rows["s"] ** 2 - rows["deviation"] ** 2, 0.0)))
    body.append(["observed less the fitted run", rms(rows["value"] - rows["fitted"])])
    if "full_order" in rows:
        body.append(
            ["observed less the full-order run at the estimate", rms(rows["value"] - rows["full_order"])]
        )
    return Rows(["", "RMS [mm]"], body, [False, True])


def _pictures(view: View, model: Model, found: Fit, rows: pd.DataFrame, folder: Path) -> list[Picture]:
    ids = [model.run.id]
    pictures = []
    of_points = rows[rows["what"].isin(AXES)]
    if len(of_points):
        last = of_points[of_points["t"] == of_points["t"].max()]
        wide = last.pivot_table(index=["X", "Y", "Z"], columns="what", values=["value", "fitted"])
        empty = pd.Series(np.nan, wide.index)
        observed, fitted = (
            np.stack([wide.get((kind, axis), empty) for axis in AXES], 1) for kind in ("value", "fitted")
        )
        t = float(last["t"].iloc[0])
        frame = torch.as_tensor(found.xhat[round(t / model.dt)], device=model.device)
        body = model.positions(frame, np.arange(len(model.manifold.X))).cpu().numpy()
        files = save(points_chart(body, observed, fitted, t), folder, "points")
        pictures.append(Picture(files, "Observed and fitted points at the last time that was observed.", ids))
    files = save(residuals_chart(rows), folder, "residuals")
    told = "What the runs leave of the observations over time; the full-order run is at the estimate."
    return [*pictures, Picture(files, told, ids)]
