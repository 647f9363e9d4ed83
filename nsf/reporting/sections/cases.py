"""Errors over the parameters of scenes with several, or with forcing programs: charts and maps."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from nsf.data.case import Case
from nsf.errors import ConfigError
from nsf.reporting.drawing.cases import COLORS, Cases, Parameter, error_maps, error_over_parameters
from nsf.reporting.sections.variant import Variant
from nsf.reporting.study import SEEDS
from nsf.reporting.tables import VARIANT, setting_without, variant_labels
from nsf.reporting.text.columns import SETTING, telling
from nsf.results.page import Picture, Section
from nsf.results.scales import LOST
from nsf.results.style import save

_LOST = f"A run is lost that diverged or is off by more than {LOST:,.0f} %."
_Alike = Sequence[Variant]


def cases_section(groups: Sequence[_Alike], folder: Path) -> list[Section]:
    """Displacement errors of held-out cases over each parameter, and over both where there are two.

    Args:
        groups: variants that differ in seeds alone stand together.
        folder: of the report.

    Returns:
        Nothing where each case is the number of one parameter. Operators that left every run to projected
        steps are not drawn, since these are runs of the projected steps.
    """
    bodies: dict[tuple, list[tuple[_Alike, dict[Case, float]]]] = {}
    shown = [alike for alike in groups if not all(v.left() for v in alike)]
    some_left = len(shown) < len(groups)
    left = " Operators that left every run to projected steps are not shown." if some_left else ""
    for alike in shown:
        if errors := _errors(alike):
            names = tuple(next(iter(errors)).parameters)
            bodies.setdefault((alike[0].body, names), []).append((alike, errors))
    if not bodies:
        return []
    first = [[alike[0] for alike, _ in own] for own in bodies.values()]
    drawn = [
        _cases(dict(zip(names, (errors for _, errors in own), strict=True)), variants)
        for names, variants, own in zip(_names(first), first, bodies.values(), strict=True)
    ]
    runs = sorted({run for own in bodies.values() for alike, _ in own for v in alike for run in v.runs})
    seeds = ", its mean over seeds" if any(len(alike) > 1 for alike in shown) else ""
    told = (
        f"Displacement error of held-out cases over each parameter, a dot a case{seeds}. A line is the mean "
        "over neighbouring cases, and its band goes from the smallest to the largest of them, which differ "
        f"in whatever else varies. {_LOST} It is a cross above the panel, and leaves a gap in the line."
        + left
    )
    pictures = [Picture(save(error_over_parameters(drawn), folder, "error-over-parameters"), told, runs)]
    if maps := [cases for cases in drawn if len(cases.parameters) == 2]:
        told = (
            f"Displacement error of held-out cases in the plane of both parameters, a dot a case{seeds}: a "
            f"panel for each method, the best first, and one colour scale for all. {_LOST}"
        )
        told += " Grey crosses are the training cases." if any(len(cases.trained) for cases in maps) else ""
        told += left
        files = save(error_maps(maps), folder, "error-map", ramps=[COLORS])
        pictures.append(Picture(files, told, runs))
    return [Section("Over the parameters", pictures)]


def _errors(alike: _Alike) -> dict[Case, float]:
    """The mean error of each held-out case over seeds, a fraction; ∞ where a run diverged.

    Empty where cases are numbers, or cannot be read. Those that were not measured are left out.
    """
    found: dict[Case, list[float]] = {}
    for v in alike:
        shown = v.rows[v.rows["split"] == v.held_out]
        for named, error in zip(shown["parameter"], shown["displacement_error"], strict=True):
            case = _read(named)
            if case is not None and not pd.isna(error):
                found.setdefault(case, []).append(float(error))
    return {case: float(np.mean(errors)) for case, errors in found.items()}


def _read(named) -> Case | None:
    """A case with a problem parameter; None of a number, and of text that names none."""
    try:
        case = Case.read(named) if isinstance(named, str) else None
    except ConfigError:
        return None
    return case if case is not None and case.parameters else None


def _cases(errors: Mapping[str, Mapping[Case, float]], variants: _Alike) -> Cases:
    """Of one body, by solver; `variants` tell its design."""
    sources = [source for v in variants for source in v.sources]
    case = next(iter(next(iter(errors.values()))))
    names = tuple(case.parameters)
    units = dict(zip(case.names, case.units, strict=True))
    logarithmic = sources[0].logarithmic
    trained = next(filter(None, (source.training_cases for source in sources)), [])
    return Cases(
        variants[0].body,
        [Parameter(name.replace("_", " "), units[name], name in logarithmic) for name in names],
        {
            solver: (np.array([[case[name] for name in names] for case in own]), np.array([*own.values()]))
            for solver, own in errors.items()
        },
        np.array([[one[name] for name in names] for one in trained if one.keys() >= {*names}]).reshape(
            -1, len(names)
        ),
    )


def _names(bodies: Sequence[Sequence[Variant]]) -> list[list[str]]:
    """Names of solvers, the same in all bodies: the method, and what more tells those of a body apart."""
    rows = [[_settled(v.rows.iloc[0].to_dict()) for v in own] for own in bodies]
    of_bodies = [row | {"body": i} for i, own in enumerate(rows) for row in own]
    columns = ("engine", "field", SETTING, "r", "sample", "precision", "device")
    told = ["method", *telling(of_bodies, columns, beside=("body", "method"))]
    hidden = dict.fromkeys((name for name in VARIANT if name not in told), "")
    labels = iter(variant_labels([row | hidden for own in rows for row in own]))
    return [[next(labels) for _ in own] for own in rows]


def _settled(row: dict) -> dict:
    """A row whose setting tells neither the seeds nor the body."""
    return row | {SETTING: setting_without(row[SETTING], [*SEEDS, "material"])}
