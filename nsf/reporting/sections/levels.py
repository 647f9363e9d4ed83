"""Who took the steps of runs by operators: a picture beside the runs of one level alone."""

import re
from collections.abc import Sequence
from pathlib import Path

from nsf.reporting.drawing.levels import levels_over_time, name_of
from nsf.reporting.sections.variant import Variant
from nsf.reporting.study import SEEDS
from nsf.reporting.tables import setting_without
from nsf.reporting.text.columns import SETTING, parameter_text
from nsf.results.formats import file_name
from nsf.results.page import Picture, Section
from nsf.results.style import save

#: Columns that variants have in common whose steps are the same but for the engine.
_ALIKE = ("method", "field", "r", "precision", "device")


def levels_section(known: Sequence[Variant], folder: Path) -> list[Section]:
    """A picture a body in which a run had more than one level, at the first such value; none without one.

    Args:
        known: the variants of the report.
        folder: of the report.
    """
    pictures = []
    for body in dict.fromkeys(variant.body for variant in known):
        own = [variant for variant in known if variant.body == body]
        series = [variant.series(held_out_only=True) for variant in own]
        mixed = [
            part["parameter"].iloc[0]
            for rows in series
            if "by" in rows
            for _, part in rows.groupby("parameter")
            if part["by"].nunique() > 1
        ]
        if not mixed:
            continue
        seed = next(v.seeds for v, rows in zip(own, series, strict=True) if _is_mixed(rows, mixed[0]))
        parts = [
            (variant, part)
            for variant, rows in zip(own, series, strict=True)
            if variant.seeds == seed and len(part := rows[rows["parameter"] == mixed[0]]) and "by" in part
        ]
        shown, runs = {}, {run for variant, _ in parts for run in variant.runs}
        several = len({_setting(variant) for variant, part in parts if (part["by"] == 0).any()}) > 1
        for variant, part in parts:
            name = name_of(part)
            if several and _setting(variant):
                name += f", {_setting(variant)}"
            shown[f"{name}, {variant.label}" if name in shown else name] = part
        name, unit = own[0].parameter
        caption = (
            f"The displacement error over time at {name} {parameter_text(mixed[0], '', unit)}, and who took "
            "each step: the operators, and who went on where the run was not to be believed."
        )
        alone = len({variant.body for variant in known}) == 1
        stem = "levels" if alone else file_name(f"{body}-levels")
        pictures.append(Picture(save(levels_over_time(shown), folder, stem), caption, sorted(runs)))
    return [Section("Who took the steps", pictures)] if pictures else []


def _setting(variant: Variant) -> str:
    """What its run sets, but for seeds; of each key the last part."""
    return re.sub(r"[\w.]+\.(?=\w+=)", "", setting_without(variant.rows[SETTING].iloc[0], SEEDS))


def _is_mixed(rows, value) -> bool:
    return "by" in rows and bool(rows.loc[rows["parameter"] == value, "by"].nunique() > 1)


def lend_stages(known) -> None:
    """Show the stages of a projected step beside a run by operators, whose own step has but one.

    That of a variant like it but for the engine.
    """
    for v in known:
        if len(v.breakdown.get("reduced", {})) != 1:
            continue
        for other in known:
            stages = other.breakdown.get("reduced", {})
            alike = all(other.rows[key].iloc[0] == v.rows[key].iloc[0] for key in _ALIKE)
            if len(stages) > 1 and alike and other.alike == v.alike:
                v.breakdown, v.timed = v.breakdown | {"reduced": stages}, "the projected step's"
                break
