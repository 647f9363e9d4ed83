"""A designed program, its run by recurrence, and the full-order run along it."""

from collections.abc import Callable
from contextlib import suppress

import pandas as pd

from nsf.deployment.trust import bound_text, percent
from nsf.errors import ConfigError
from nsf.inverse.design import Designed, Program, Tilt, design, full_order
from nsf.inverse.fit import ModelError
from nsf.inverse.observations import View
from nsf.inverse.reports.charts import program_chart
from nsf.inverse.reports.page import Chart, Results, frame_table, rms, title_of
from nsf.results.columns import number

#: Tolerances (RMS) beyond which the targets count as missed.
_MISSED = 3.0
_MOST = 20  # targets that the page lists
_LEAD = "A program of forcing that is to bring a target about, from gradients through runs by recurrence."
_TERMS = (
    ("off", "root mean square, over the targets, of the target less what a run has."),
    ("the model's own error", "the same of runs by recurrence less full-order runs, in validation cases."),
    (
        "error bound",
        "of the displacement error of the run, as validation runs show it (docs/method.md, Trust).",
    ),
)


def designing(
    program: Program,
    view: View,
    parameters,
    run_full_order: bool = True,
    seed: int = 0,
    say: Callable[[str], object] = print,
) -> Results:
    """Design, and run the full-order solver along the program.

    Args:
        program, view, parameters: as for `design`.
        run_full_order: whether to make that run.
        seed: of the programs to begin at.
        say: called with a line of what is done.

    Returns:
        A page with `program.csv` and `targets.csv`.
    """
    model = program.model
    designed = design(program, view, parameters, seed)
    rows = view.observations.frame.rename(columns={"deviation": "tolerance"}).assign(fitted=designed.seen)
    off = {"run by recurrence": rms(rows["value"] - rows["fitted"])}
    if run_full_order:
        rows["full_order"] = view.of_truth(full_order(program, designed, parameters))
        off["full-order run"] = rms(rows["value"] - rows["full_order"])
    with suppress(ConfigError):  # without validation runs nothing is known of it
        off["the model's own error"] = rms(ModelError.of(view, model).deviations)
    say("design: off by: " + ", ".join(f"{name} {number(1e3 * value)} mm" for name, value in off.items()))
    ways = dict(zip(program.names, designed.values.T, strict=True))
    table = pd.DataFrame({"": list(off), "off [mm]": [1e3 * value for value in off.values()]})
    drawn = program_chart(model.t, ways, program.unit)
    count = f"{len(rows)} target{'s' * (len(rows) != 1)}"
    return Results(
        title=f"{title_of(model)}: design",
        lead=_LEAD,
        models=[model],
        tables=[
            frame_table("How far off", table, f"{count}."),
            frame_table("Targets", _shown(rows), f"The first {_MOST} at most [m, s]; targets.csv has all."),
        ],
        files={"program.csv": pd.DataFrame({"t": model.t} | ways), "targets.csv": rows},
        charts=[Chart("Program", "program", "The program over time.", drawn)],
        facts=[("Search", designed.stopped), ("Error bound", percent(designed.error_bound))],
        definitions=_TERMS,
        warnings=_warnings(program, designed, rms((rows["value"] - rows["fitted"]) / rows["tolerance"])),
        settings={"seed": seed, "knots": program.knots, "bounds": program.bounds.tolist()},
    )


def _shown(rows: pd.DataFrame) -> pd.DataFrame:
    """The first targets, what they are of before all numbers, without columns that are empty."""
    first = rows.head(_MOST).dropna(axis=1, how="all")
    return first[["what", *(name for name in first if name != "what")]].rename(
        columns=lambda name: name.replace("_", " ")
    )


def _warnings(program: Program, designed: Designed, missed: float) -> list[str]:
    """Sentences on a program whose run misses its targets by so many tolerances (RMS), with one remedy."""
    doubted = designed.error_bound > (limit := program.model.trust.limit)
    untaught = isinstance(program, Tilt) and not program.model.scene.forcing.gravity
    if untaught:
        remedy = "train with programs of scene.forcing.gravity: the fields know no shape that a tilt makes"
    elif doubted:
        remedy = "choose targets nearer by, or train with more programs"
    else:
        remedy = "allow wider bounds or more knots, or choose targets nearer by"
    warnings = []
    if missed > _MISSED:
        warnings.append(
            f"no program was found that reaches the targets; the best misses them by {missed:.3g} "
            f"tolerances; {remedy}"
        )
    elif untaught:
        warnings.append(remedy)
    if doubted:
        warnings.append(f"the run is not to be believed: {bound_text(designed.error_bound, limit)}")
    return warnings
