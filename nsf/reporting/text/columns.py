"""What each column of `results.csv` is called, its unit, and how its numbers are written."""

import json
import math
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass

from nsf.data.case import with_unit


@dataclass(frozen=True)
class Column:
    """One column as a reader sees it.

    Attributes:
        name: the key in `results.csv`.
        title: the heading, without the unit.
        unit: shown after the heading; empty for text and pure numbers.
        scale: the csv's number times this is what is shown (fractions become per cent).
    """

    name: str
    title: str
    unit: str = ""
    scale: float = 1.0

    @property
    def heading(self) -> str:
        """Title with its unit in brackets."""
        return f"{self.title} [{self.unit}]" if self.unit else self.title

    def text(self, value) -> str:
        """The csv's value as shown in a cell."""
        return number(value, self.scale)


_SPEC = (
    Column("scene", "scene"),
    Column("method", "method"),
    Column("field", "field"),
    Column("r", "r"),
    Column("engine", "engine"),
    Column("sample", "|S|"),
    Column("integration_mean", "mean |N|"),
    Column("parameter", "parameter"),
    Column("split", "split"),
    Column("delta", "δ", "%", 100.0),
    Column("displacement_error", "displacement error", "%", 100.0),
    Column("stress_error", "stress error", "%", 100.0),
    Column("displacement_static", "nothing moves", "%", 100.0),
    Column("displacement_nearest", "nearest training run", "%", 100.0),
    Column("displacement_interpolated", "interpolated latents", "%", 100.0),
    Column("displacement_coarse", "coarse full order", "%", 100.0),
    Column("gamma", "γ"),
    Column("step_ms_full", "full-order step", "ms"),
    Column("step_ms_reduced", "reduced step", "ms"),
    Column("step_ms_coarse", "coarse full-order step", "ms"),
    Column("total_ms_full", "full-order run", "ms"),
    Column("total_ms_reduced", "reduced run", "ms"),
    Column("total_ms_coarse", "coarse full-order run", "ms"),
    Column("decode_ms", "decoding its frames", "ms"),
    Column("speedup_step", "speedup, step", "×"),
    Column("speedup_total", "speedup, total", "×"),
    Column("memory_full_mib", "full-order memory", "MiB"),
    Column("memory_reduced_mib", "reduced memory", "MiB"),
    Column("teach_seconds", "teaching", "s"),
    Column("break_even_runs", "runs until it pays"),
    Column("handed_over", "handed on", "%", 100.0),
    Column("estimated_error", "estimated error", "m"),
    Column("true_error", "true error", "m"),
    Column("height_error", "height, off", "m"),
    Column("run_out_error", "run-out, off", "m"),
    Column("opening_error", "opening, off", "m"),
    Column("springback_error", "springback, off", "m"),
    Column("precision", "precision"),
    Column("device", "device"),
    Column("commit", "commit"),
)

COLUMNS = tuple(column.name for column in _SPEC)
"""Columns of `results.csv`, in order. Errors and δ are fractions there."""
RIVALS = (
    "displacement_static", "displacement_nearest", "displacement_interpolated", "displacement_coarse",
)  # fmt: skip
"""Displacement errors of what a reduced run is held to, beside its own."""
LATER = (
    "engine", *RIVALS, "step_ms_coarse", "total_ms_full", "total_ms_reduced", "total_ms_coarse", "decode_ms",
    "teach_seconds", "break_even_runs", "handed_over", "estimated_error", "true_error", "height_error",
    "run_out_error", "opening_error", "springback_error",
)  # fmt: skip
"""Columns that older runs and reports lack: they are read as empty."""

SETTING, VALUES, TRAINING, PLACE = "setting", "values", "training_seconds", "place"
SOLVER = "solver"
_MORE = (
    Column(SETTING, "setting"),
    Column(VALUES, "values"),
    Column(TRAINING, "training", "s"),
    Column(PLACE, "in the paper"),
    Column(SOLVER, "solver"),
    Column("step_ms", "step", "ms"),
    Column("total_ms", "run", "ms"),
    Column("shown_ms", "run, frames decoded", "ms"),
    Column("speedup_shown", "speedup, frames decoded", "×"),
    Column("displacement_worst", "its largest", "%", 100.0),
    Column("delta_static", "δ if nothing moves", "%", 100.0),
    Column("memory_mib", "memory", "MiB"),
)
COLUMN = {column.name: column for column in (*_SPEC, *_MORE)}
"""Columns of tables: those of `results.csv`; a variant's setting beyond them; and what means are beside."""

TEXT = (
    "scene",
    "method",
    "field",
    "engine",
    "sample",
    "split",
    "precision",
    "device",
    "commit",
    SETTING,
    PLACE,
    SOLVER,
)
COSTS = (
    "step_ms_full", "step_ms_reduced", "step_ms_coarse", "total_ms_full", "total_ms_reduced",
    "total_ms_coarse", "decode_ms", "speedup_step", "speedup_total", "memory_full_mib", "memory_reduced_mib",
    "teach_seconds", "break_even_runs",
)  # fmt: skip
"""Columns measured once a variant."""
MEASURED = ("delta", "displacement_error", "stress_error", *RIVALS, "handed_over", *COSTS)
"""Columns that are averaged over parameter values; speedups are then of mean times (`speedups`)."""
_TIMES = {
    "speedup_step": ("step_ms_full", "step_ms_reduced"),
    "speedup_total": ("total_ms_full", "total_ms_reduced"),
    "speedup_shown": ("total_ms_full", "shown_ms"),
}

ABSENT = "–"
_LISTED = 6  # entries of a list that is shown whole


def number(value, scale: float = 1.0) -> str:
    """A value with three significant digits (integers and text in full); `–` where nothing was measured."""
    if isinstance(value, str):
        return value
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return ABSENT
    if math.isinf(value):
        return "∞"
    shown = float(value) * scale
    if abs(shown) >= 1e6:
        return f"{shown:.2e}"
    if shown == int(shown) or abs(shown) >= 1000:
        return f"{shown:,.0f}"
    if abs(shown) < 1e-3:
        return f"{shown:.2e}"
    digits = max(0, 2 - math.floor(math.log10(abs(shown))))
    return f"{shown:.{digits}f}"


def brief(text: str) -> str:
    """A text with the ends and the count of each list of more than six entries: `[0 to 28, 25 values]`."""

    def told(found: re.Match) -> str:
        values = [value.strip() for value in found[1].split(",")]
        return f"[{values[0]} to {values[-1]}, {len(values)} values]" if len(values) > _LISTED else found[0]

    return re.sub(r"\[([^\[\]{}]*)\]", told, text)


def distinct(texts: Sequence[str]) -> list[str]:
    """The texts, each `brief` unless two that differ would be one."""
    short = [brief(text) for text in texts]
    return short if len(set(short)) == len(set(texts)) else list(texts)


def telling(rows: Sequence[Mapping], keys: Iterable[str], beside: Sequence[str] = ()) -> list[str]:
    """Keys that tell rows apart: each parts rows that `beside` and the keys before it leave together.

    Args:
        rows: values count as text, so NaN is NaN; a key that a row lacks counts as None.
        keys: in the order in which they are tried.
        beside: keys that count as told already; they are not returned.
    """

    def kinds(names: Sequence[str]) -> int:
        return len({tuple(str(row.get(name)) for name in names) for row in rows})

    told = list(beside)
    for key in keys:
        if kinds([*told, key]) > kinds(told):
            told.append(key)
    return told[len(beside) :]


def counted(lists: Collection, scenes: Collection[str]) -> list:
    """Lengths in place of texts such as `[21,38.5]`; all as they are where two of a scene have one length."""
    lengths = [len(json.loads(text)) if str(text).startswith("[") else text for text in lists]
    told = {(scene, str(text)) for scene, text in zip(scenes, lists, strict=True)}
    kept = {(scene, str(length)) for scene, length in zip(scenes, lengths, strict=True)}
    return lengths if len(told) == len(kept) else list(lists)


def speedups(means: Mapping[str, float]) -> dict[str, float]:
    """Speedups of mean times, where these were measured: a mean of ratios would hide runs that are slow."""
    known = {name: [means.get(time, math.nan) for time in times] for name, times in _TIMES.items()}
    return {name: full / reduced for name, (full, reduced) in known.items() if full > 0 and reduced > 0}


def plus_minus(mean: float, deviation: float, scale: float = 1.0) -> str:
    """A mean and the deviation of what it is of, as shown; the mean alone where the deviation is none."""
    if not math.isfinite(deviation):
        return number(mean, scale)
    spread = scale * deviation
    return (
        f"{number(mean, scale)} ± {spread:.2g}" if spread < 99.5 else f"{number(mean, scale)} ± {spread:,.0f}"
    )


def parameter_text(value, name: str = "", unit: str = "") -> str:
    """A parameter value as printed beside a picture: `friction angle 27.5°`."""
    shown = value if isinstance(value, str) else f"{value:g}"
    return f"{name} {with_unit(shown, unit)}".strip()


def axis(title: str, unit: str = "") -> str:
    """An axis label: the quantity and its unit in brackets."""
    return f"{title} [{unit}]" if unit not in ("", "-") else title


def device_type(device: str) -> str:
    """`cuda:0` and `cuda:1` are one type of device: what stands before the colon."""
    return str(device).split(":")[0].strip().lower()


def split_rank(split: str) -> tuple[int, str]:
    """Sorts held-out values before those trained on."""
    order = ("test", "validation", "extrapolation")
    return (order.index(split) if split in order else 9 if split == "train" else 5, str(split))
