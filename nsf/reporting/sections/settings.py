"""The bodies of a sweep at each of its settings, below each other."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from nsf.bodies.colors import DIFFERENCE_COLORS, STRESS_COLORS
from nsf.reporting.bodies import shapes
from nsf.reporting.sections.variant import ROWS, Variant, order
from nsf.reporting.sources import Study
from nsf.reporting.study import SEEDS
from nsf.reporting.text.columns import brief, telling
from nsf.results.formats import file_name
from nsf.results.page import Picture, Section
from nsf.results.style import save
from nsf.vectors import spaced

_TOLD = (
    "Last frame at each setting, at most six of them, all at one held-out value: the worst one of the "
    "setting with the smallest mean δ. The right column has the distance from the full-order run."
)

Setting = tuple[tuple[str, str], ...]  # keys and values


def settings_section(known: Sequence[Variant], folder: Path, study: Study) -> list[Section]:
    """The last frame of one held-out case of each body at its settings; variants without it are left out.

    Args:
        known: the variants of the report.
        folder: where pictures go.
        study: what the sweep varies.
    """
    pictures = []
    for body in dict.fromkeys(v.body for v in known):
        settings = _by_setting([v for v in known if v.body == body and v.method == "nsf"], study)
        if len(rows := _rows(settings)) > 1:
            first = next(iter(settings.values()))
            drawn = save(
                shapes.final_shapes(rows, *first.parameter),
                folder, file_name(f"{body}-settings"), ("png",), [STRESS_COLORS, DIFFERENCE_COLORS],
            )  # fmt: skip
            pictures.append(Picture(drawn, _TOLD, sorted({run for v in settings.values() for run in v.runs})))
    return [Section("Bodies at each setting", pictures)] if pictures else []


def _by_setting(variants: Sequence[Variant], study: Study) -> dict[Setting, Variant]:
    """The variants by what was set, of several seeds the first."""
    found: dict[Setting, Variant] = {}
    for v in variants:
        keys = study.keys.get(v.runs[0], {})
        found.setdefault(tuple((key, str(value)) for key, value in keys.items() if key not in SEEDS), v)
    return found


def _rows(settings: Mapping[Setting, Variant]) -> list[shapes.Case]:
    """One case at the settings, or at some of them evenly, each named by what differs."""
    if len(settings) < 2:
        return []
    (worst, _), *_ = min(settings.values(), key=order).ranked()
    shown = [list(settings.items())[i] for i in spaced(len(settings), ROWS)]
    known = [dict(setting) for setting in settings]
    told = telling(known, dict.fromkeys(key for setting in known for key in setting))
    return [
        case
        for setting, v in shown
        for case in v.case_at(worst, ", ".join(f"{k}={brief(value)}" for k, value in setting if k in told))
    ]
