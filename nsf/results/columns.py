"""The columns of the table of results, as `columns.csv` declares them: name, title, unit, kind and meaning.

A row of the table is a (run, case, seed, model). Charts, pages, the README, `nsf runs` and LaTeX take
headings and units from here. Errors are fractions in the table and per cent where they are shown. In
`columns.csv` a column is of the `table`, or `derived`: computed from it, or a setting on an axis of charts.
"""

import csv
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

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
        meaning: its definition, for a reader.
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
            return ABSENT if is_empty(value) else brief(str(value))
        return number(value, self.scale)


def _declared(of: str) -> dict[str, Column]:
    """The columns of the table, or those derived from it, by name and in order."""
    with open(Path(__file__).with_name("columns.csv"), encoding="utf-8", newline="") as stream:
        rows = [row for row in csv.DictReader(stream) if row["of"] == of]
    return {row["name"]: _column(row) for row in rows}


def _column(row: Mapping[str, str]) -> Column:
    """A column of a kind: `text`; `number`; or `measured`, a number that is averaged over cases.

    `fraction` and `error` are the last two of a number without unit that is shown in per cent.
    """
    kind, scale = row["kind"], 100.0 if row["kind"] in ("fraction", "error") else 1.0
    name, title, unit, meaning = (row[key] for key in ("name", "title", "unit", "meaning"))
    return Column(name, title, unit, scale, meaning, kind == "text", kind in ("measured", "error"))


COLUMNS = _declared("table")
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

DERIVED = _declared("derived")
"""Columns computed from the table, and settings that are an axis of charts."""


def column(name: str) -> Column:
    """The column of a name; a setting that none describes is called by the last part of its key."""
    declared = COLUMNS.get(name) or DERIVED.get(name)
    return declared or Column(name, name.rpartition(".")[2].replace("_", " "), text=True)


def axis(title: str, unit: str = "") -> str:
    """A heading: the quantity and its unit in brackets."""
    return f"{title} [{unit}]" if unit not in ("", "-") else title


def number(value, scale: float = 1.0) -> str:
    """A value with three significant digits (integers and text in full); `–` where nothing was measured."""
    if isinstance(value, str):
        return value
    if is_empty(value):
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


def model_name(row: Mapping) -> str:
    """A model in words: `projected`, with what is not the paper's; the baseline under a name of its own."""
    name, stress, affine = str(row["model"]), row.get("stress") or "field", row.get("affine") or "field"
    if name != "projected":
        return name
    if (stress, affine) == ("deformation", "none"):
        return BASELINE
    changed = [f"stress={stress}"] if stress != "field" else []
    # Particles that carry their stress carry their affine velocity as well.
    if affine != ("particles" if stress == "particles" else "field"):
        changed.append(f"affine={affine}")
    return ", ".join([name, *changed])


def is_empty(value) -> bool:
    """Whether a cell of a table holds nothing."""
    return value is None or value == "" or (isinstance(value, float) and math.isnan(value))
