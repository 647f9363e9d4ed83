"""A designed program, its run by operators, and the full-order run beside it."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd

from nsf.errors import ConfigError
from nsf.inverse.design import Designed, Program, Tilt, design, full_order
from nsf.inverse.error import ModelError
from nsf.inverse.observations import View
from nsf.inverse.reports.charts import program_chart, residuals_chart
from nsf.inverse.reports.page import Results, write
from nsf.reporting.text.columns import number
from nsf.results.formats import Rows
from nsf.results.page import Picture, Section, Table
from nsf.results.style import save

#: Tolerances (RMS) beyond which the targets count as missed.
_MISSED = 3.0
_LEAD = "A program of forcing that is to bring a target about, found by gradients through runs by operators."
_TERMS = (
    ("off", "root mean square, over the targets, of the target less what a run has."),
    ("the model's own error", "the same of runs by operators less full-order runs, in validation cases."),
    ("distrust", "how far the run is from what was taught; above 1 it is not to be believed."),
)


def report(
    program: Program,
    view: View,
    parameters,
    folder: Path,
    *,
    run_full_order: bool = True,
    seed: int = 0,
    say: Callable[[str], object] = print,
) -> tuple[Path, Designed]:
    """Design, run the full-order solver along the program, and write `program.csv` and `targets.csv`.

    Args:
        program, view, parameters: as for `design`.
        folder: of the page.
        run_full_order: whether to make that run.
        seed: of the random programs.
        say: told what is done.
    """
    model, own = program.model, view.observations
    found = design(program, view, parameters, seed, say)
    rows = pd.DataFrame(
        {
            "t": own.t, "what": own.what, **dict(zip(("X", "Y", "Z"), own.points.T, strict=True)),
            "value": own.values, "tolerance": own.deviations, "fitted": found.seen,
        }
    )  # fmt: skip
    body = [["run by operators", number(1e3 * _rms(rows["value"] - rows["fitted"]))]]
    if run_full_order:
        rows["full_order"] = view.of_truth(full_order(program, found, parameters))
        body.append(["full-order run", number(1e3 * _rms(rows["value"] - rows["full_order"]))])
    try:
        error = _rms(ModelError.of(view, model).deviations)
        body.append(["the model's own error", number(1e3 * error)])
    except ConfigError:  # no validation runs: nothing is known of it
        error = float("nan")
    told = ", ".join(f"{what} {value} mm" for what, value in body)
    say(f"design: off by: {told}")
    ways = dict(zip(program.names, found.values.T, strict=True))
    missed = (rows["value"] - rows["fitted"]) / rows["tolerance"]
    warnings = _warnings(program, found, _rms(missed))
    for warning in warnings:
        say(f"design: warning: {warning}")

    def draw(fresh: Path) -> list[Section]:
        ids = [model.run.id]
        files = save(program_chart(model.t, ways, program.unit), fresh, "program")
        pictures = [Picture(files, "The program over time.", ids)]
        files = save(residuals_chart(rows, "target"), fresh, "targets")
        return [Section("Program", [*pictures, Picture(files, "Targets less what the runs have.", ids)])]

    title = model.scene.config.scene.get("title") or model.scene.name
    count = f"{len(rows)} target{'s' * (len(rows) != 1)}."
    results = Results(
        title=f"{title}: design",
        lead=_LEAD,
        tables=[Table("How far off", Rows(["", "off [mm]"], body, [False, True]), count)],
        files={"program.csv": pd.DataFrame({"t": model.t} | ways), "targets.csv": rows},
        runs=[model.run, *model.run.parent_runs],
        draw=draw,
        facts=[("Search", found.stopped), ("Distrust", number(found.distrust))],
        definitions=_TERMS,
        warnings=warnings,
        asked={"seed": seed, "knots": program.knots, "bounds": program.bounds.tolist()},
    )
    return write(results, folder), found


def _warnings(program: Program, found: Designed, missed: float) -> list[str]:
    """What a reader must know of a program whose run misses its targets by so many tolerances (RMS)."""
    told = []
    if missed > _MISSED:
        told.append(
            f"no program was found that reaches the targets; the best misses them by {missed:.3g} "
            "tolerances; allow wider bounds or more knots, or choose targets nearer by"
        )
    if found.distrust > 1.0:
        told.append(f"the run is {found.distrust:.3g} times as far from what was taught as may be believed")
    if isinstance(program, Tilt) and not program.model.scene.forcing.gravity:
        told.append(
            "gravity was the same in all training runs, so the fields know no shape that a tilt makes; train "
            "with scene.forcing.gravity"
        )
    return told


def _rms(values) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
