"""The columns of the table of results: the name, title, unit, scale and meaning of each, said once.

A row of the table is a (run, case, seed, model). Charts, pages, the README, `nsf runs` and LaTeX take
headings and units from here. Errors are fractions in the table and per cent where they are shown.
"""

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass

from nsf.data.case import with_unit

ABSENT = "–"
"""Shown where nothing was measured."""
BASELINE = "deformation only (baseline)"
"""Name of projected steps that take τ from the deformation and C = 0, after Chen et al. 2023."""

_LISTED = 6  # entries of a list that is shown whole


@dataclass(frozen=True)
class Column:
    """One column.

    Attributes:
        name: its key in the table.
        title: its heading, without the unit.
        unit: as shown after the heading; empty of text and pure numbers.
        scale: the table's number times this is shown (fractions become per cent).
        meaning: what a reader needs to know of it.
        text: whether it holds text.
        measured: whether it is averaged over cases.
    """

    name: str
    title: str
    unit: str = ""
    scale: float = 1.0
    meaning: str = ""
    text: bool = False
    measured: bool = False

    @property
    def heading(self) -> str:
        """Title with its unit in brackets."""
        return axis(self.title, self.unit)

    def cell(self, value) -> str:
        """A value of the table as shown."""
        if self.text:
            return ABSENT if _is_missing(value) or value == "" else brief(str(value))
        return number(value, self.scale)


def _text(name: str, title: str, meaning: str) -> Column:
    return Column(name, title, meaning=meaning, text=True)


def _percent(name: str, title: str, meaning: str) -> Column:
    return Column(name, title, "%", 100.0, meaning, measured=True)


def _measured(name: str, title: str, unit: str, meaning: str) -> Column:
    return Column(name, title, unit, meaning=meaning, measured=True)


_IDENTITY = (
    _text("report", "report", "The experiment, and its part after a slash, that the row is of."),
    _text("run", "run", "The evaluate run that measured the row."),
    _text("scene", "scene", "The scene, by the name of its yaml."),
    _text("material", "material", "The law of the material that was deployed."),
    _text(
        "model",
        "model",
        "Which model took the steps: projected is the paper's; recurrence steps the latent vector by a "
        "learned map; interpolate takes no step.",
    ),
    _text("teacher", "teacher", "What a recurrence learned from: full-order runs, or projected steps."),
    _text(
        "stress",
        "stress",
        "Where a projected step takes τ from: its field (the paper), the deformation, or the particles.",
    ),
    _text(
        "affine", "affine", "Where a projected step takes C from: its field, none (C = 0), or the particles."
    ),
    _text("field", "field", "The fields: basis (modes) or mlp (the paper's networks)."),
    Column("r", "r", meaning="Number of latent coordinates."),
    Column("sample", "|S|", meaning="Number of sample particles."),
    Column("integration", "mean |N|", meaning="Number of integration particles, the mean over the steps."),
    Column("particles", "particles", meaning="Number of full-order particles."),
    _text("case", "case", "Parameter values of the run, with units."),
    Column("value", "value", meaning="The value where one parameter varies, in the unit that `case` has."),
    Column("seed", "seed", meaning="Of the training: first weights and batches."),
    _text("setting", "setting", "Keys of the configuration that the report varies, as key=value; key=value."),
    _text("split", "split", "test, validation or train."),
)
_ERRORS = (
    _percent(
        "delta",
        "δ",
        "‖x_rom − x_fom‖ / ‖x_fom‖ over frames and particles: the paper's error; it depends on the origin.",
    ),
    _percent(
        "displacement_error",
        "displacement error",
        "‖x_rom − x_fom‖ / ‖x_fom − X‖: the same distance over how far particles moved.",
    ),
    _percent("stress_error", "stress error", "‖τ_rom − τ_fom‖ / ‖τ_fom‖ of the Kirchhoff stress."),
    _measured("distance", "distance", "m", "Root mean square over frames and particles of ‖x_rom − x_fom‖."),
    _measured(
        "distance_max",
        "largest distance",
        "m",
        "Largest frame's root mean square over particles of ‖x_rom − x_fom‖.",
    ),
    Column("paper_delta", "paper's δ", "%", 100.0, "δ that the paper prints for the row."),
    _percent("displacement_static", "nothing moves", "Displacement error of a body that never moves."),
    _percent(
        "displacement_nearest",
        "nearest training run",
        "Displacement error of the training run of the nearest parameters.",
    ),
    _percent(
        "displacement_interpolated",
        "interpolated latents",
        "Displacement error of latents interpolated over the parameters.",
    ),
    _percent(
        "displacement_coarse",
        "coarse full order",
        "Displacement error of the full-order solver on a coarser grid.",
    ),
    _measured(
        "height_error", "height, off", "m", "Height of the body at the end, less the full-order run's."
    ),
    _measured("run_out_error", "run-out, off", "m", "Sideways reach at the end, less the full-order run's."),
    _measured("opening_error", "opening, off", "m", "Opening at the end, less the full-order run's."),
    _measured(
        "springback_error", "springback, off", "m", "Springback at the end, less the full-order run's."
    ),
)
_COSTS = (
    _measured(
        "step_ms_full",
        "full-order step",
        "ms",
        "Median over whole runs of the mean time of a full-order step.",
    ),
    _measured("step_ms", "step", "ms", "The same of the model's step."),
    _measured("step_ms_p10", "step, 10 %", "ms", "A tenth of the runs is faster."),
    _measured("step_ms_p90", "step, 90 %", "ms", "A tenth of the runs is slower."),
    _measured(
        "step_ms_coarse",
        "coarse full-order step",
        "ms",
        "The same of the full-order solver on a coarser grid.",
    ),
    _measured("total_ms_full", "full-order run", "ms", "All steps of a full-order run."),
    _measured(
        "total_ms", "run", "ms", "All steps of the model's run; checks of the estimate are not among them."
    ),
    _measured(
        "total_ms_coarse",
        "coarse full-order run",
        "ms",
        "All steps on the coarser grid, which may be longer.",
    ),
    _measured(
        "decode_ms", "decoding its frames", "ms", "Positions of all particles at every frame of a run."
    ),
    _measured(
        "memory_full_mib", "full-order memory", "MiB", "Peak of the full-order steps, every allocator."
    ),
    _measured("memory_mib", "memory", "MiB", "Peak of the model's steps, without decoding."),
    _measured(
        "train_seconds", "training", "s", "Wall time of training the fields, where costs were measured."
    ),
    _measured("teach_seconds", "teaching", "s", "Wall time of teaching a recurrence."),
    _measured(
        "break_even_runs",
        "runs until it pays",
        "",
        "Runs that save as much time as training and teaching took.",
    ),
    _percent(
        "fallback_share",
        "by the fallback",
        "Share of the steps that another model took, since the first was not believed.",
    ),
    _measured(
        "estimated_error",
        "estimated error",
        "m",
        "Largest estimate of the distance from a run by projected steps.",
    ),
    _measured(
        "distrust",
        "distrust ratio",
        "",
        "How far the run went from the training data; above 1 it is not to be believed.",
    ),
    _measured("distrusted_at", "first distrusted", "s", "Time of the first step that was not believed."),
    _measured("fallback_at", "fallback from", "s", "Time from which the fallback went on to the end."),
)
_ORIGIN = (
    _text("precision", "precision", "fp32 or fp64."),
    _text("device", "device", "The machine that it ran on."),
    _text("commit", "commit", "The code that it ran."),
)

COLUMNS = {column.name: column for column in (*_IDENTITY, *_ERRORS, *_COSTS, *_ORIGIN)}
"""Every column of the table, in order."""
EVALUATED = tuple(name for name in COLUMNS if name not in ("report", "run", "setting", "paper_delta"))
"""Those that an evaluate run writes of itself; a report adds the others."""
TEXT = tuple(name for name, column in COLUMNS.items() if column.text)
MEASURED = tuple(name for name, column in COLUMNS.items() if column.measured)
RIVALS = ("displacement_static", "displacement_nearest", "displacement_interpolated", "displacement_coarse")
"""Displacement errors of what a model is held to."""
QUANTITIES = ("height_error", "run_out_error", "opening_error", "springback_error")
SEEDS = ("seed", "sampler.seed")
"""Columns over which means are taken, like cases."""

DERIVED = {
    column.name: column
    for column in (
        _text("body", "scene", "The scene, with its material or size where a report has several."),
        _text("variant", "variant", "What tells rows of a scene apart."),
        _text("delta_interval", "mean δ, 95 % [%]", "Middle 95 % of means of seeds and cases drawn anew."),
        Column("cases", "cases", meaning="How many cases, and seeds of each, a mean is over."),
        Column("diverged", "diverged", meaning="How many of them diverged."),
        Column("speedup_step", "speedup, step", "×", meaning="Full-order over own mean time of a step."),
        Column("speedup_total", "speedup, run", "×", meaning="The same of whole runs."),
        Column("speedup_decoded", "speedup, decoded", "×", meaning="The same with every frame decoded."),
        _percent("delta_static", "δ if nothing moves", "δ of a body that never moves."),
        _percent(
            "delta_interpolated",
            "δ of interpolated latents",
            "δ of latents interpolated over the parameters.",
        ),
        _percent("displacement_worst", "its largest", "Largest displacement error of a case."),
        Column(
            "gamma", "γ", meaning="3 |P| / r: coordinates of the full-order over those of the latent state."
        ),
        _percent("integration_share", "N", "Integration particles over all particles."),
        Column("points", "points", meaning="Points at which the fields are queried."),
        _percent("particles_delta", "δ at the particles", "δ at the training particles alone."),
        _percent("particles_displacement_error", "displacement error at them", "The same of displacement."),
        _percent("full_order_difference", "few and many particles", "Between both full-order runs."),
        _percent("interpolation_error", "interpolating the fine run", "From its own training particles."),
        _percent("smeared", "smeared", "Points that interpolation puts more than half a cell away."),
        Column("seconds", "query", "s", meaning="Time to query the fields at all points."),
        Column("full_order_seconds", "fine full-order run", "s", meaning="Its time, set-up included."),
        Column("sampler.size", "sample particles |S|"),
        Column("sampler.cells", "cells with sample particles"),
        Column("field.beta", "hidden width β over d"),
        Column("scene.bodies.column.particles", "particles"),
        Column("deploy.dt_multiplier", "deployment step", "full-order Δt"),
        Column("trainer.steps", "training steps of each network"),
        Column("training_runs", "training runs"),
    )
}
"""Columns computed from the table, and settings that are an axis of charts."""


def column(name: str) -> Column:
    """The column of a name; a setting that none describes is called by the last part of its key."""
    known = COLUMNS.get(name) or DERIVED.get(name)
    return known or Column(name, name.rpartition(".")[2].replace("_", " "), text=True)


def axis(title: str, unit: str = "") -> str:
    """A heading: the quantity and its unit in brackets."""
    return f"{title} [{unit}]" if unit not in ("", "-") else title


def number(value, scale: float = 1.0) -> str:
    """A value with three significant digits (integers and text in full); `–` where nothing was measured."""
    if isinstance(value, str):
        return value
    if _is_missing(value):
        return ABSENT
    if math.isinf(value):
        return "∞" if value > 0 else "−∞"
    shown = float(value) * scale
    if abs(shown) >= 1e6:
        return f"{shown:.2e}"
    if shown == int(shown) or abs(shown) >= 1000:
        return f"{shown:,.0f}"
    if abs(shown) < 1e-3:
        return f"{shown:.2e}"
    return f"{shown:.{max(0, 2 - math.floor(math.log10(abs(shown))))}f}"


def plus_minus(mean: float, deviation: float, scale: float = 1.0) -> str:
    """A mean ± its standard deviation; the mean alone where there is none."""
    if deviation is None or not math.isfinite(deviation):
        return number(mean, scale)
    spread = scale * deviation
    return f"{number(mean, scale)} ± {f'{spread:.2g}' if spread < 99.5 else f'{spread:,.0f}'}"


def brief(text: str) -> str:
    """A text with the ends and the count of each list of more than six entries: `[0 to 28, 25 values]`."""

    def shortened(match: re.Match) -> str:
        values = [value.strip() for value in match[1].split(",")]
        return f"[{values[0]} to {values[-1]}, {len(values)} values]" if len(values) > _LISTED else match[0]

    return re.sub(r"\[([^\[\]{}]*)\]", shortened, text)


def parameter_text(value, name: str = "", unit: str = "") -> str:
    """A parameter value as printed beside a picture: `friction angle 27.5°`."""
    shown = value if isinstance(value, str) else f"{value:g}"
    return f"{name} {with_unit(shown, unit)}".strip()


def model_name(row: Mapping) -> str:
    """A model in words: `projected`, the baseline under its own name, `recurrence taught by projected`."""
    stress, affine = row.get("stress") or "field", row.get("affine") or "field"
    name = str(row["model"])
    if name == "projected" and (stress, affine) == ("deformation", "none"):
        return BASELINE
    if name == "projected" and (stress, affine) != ("field", "field"):
        return f"projected, stress={stress}, affine={affine}"
    if name == "recurrence" and row.get("teacher"):
        return f"recurrence taught by {row['teacher']}"
    return name


def _is_missing(value) -> bool:
    return value is None or (isinstance(value, float) and math.isnan(value))
