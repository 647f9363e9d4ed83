"""The bodies of a sweep at each of its settings, below each other."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from nsf.reporting.drawing import shapes
from nsf.reporting.drawing.style import DIFFERENCE_COLORS, STRESS_COLORS, save
from nsf.reporting.sources import Study
from nsf.reporting.study import SEEDS
from nsf.reporting.text.formats import file_name
from nsf.reporting.text.page import Picture, Section
from nsf.reporting.variant import ROWS, Variant, order


def settings_section(known: Sequence[Variant], folder: Path, study: Study) -> list[Section]:
    """The last frame of one held-out case of each scene, by every setting, or by some evenly."""
    pictures = []
    for scene in dict.fromkeys(v.scene for v in known):
        alike: dict[tuple, Variant] = {}  # of several seeds the first
        for v in known:
            keys = study.keys.get(v.runs[0], {})
            if v.scene == scene and v.method == "nsf":
                alike.setdefault(tuple((k, str(e)) for k, e in keys.items() if k not in SEEDS), v)
        if len(alike) < 2:
            continue
        varied = {key for key, _ in set().union(*alike) - set.intersection(*map(set, alike))}
        chosen = np.unique(np.linspace(0, len(alike) - 1, min(ROWS, len(alike))).round().astype(int))
        (worst, _), *_ = min(alike.values(), key=order).ranked()
        rows = [
            case
            for keys, v in (list(alike.items())[i] for i in chosen)
            for case in v.at(worst, ", ".join(f"{key}={value}" for key, value in keys if key in varied))
        ]
        if len(rows) > 1:
            v = next(iter(alike.values()))
            drawn = save(
                shapes.final_shapes(rows, *v.parameter),
                folder, file_name(f"{scene}-settings"), ("png",), [STRESS_COLORS, DIFFERENCE_COLORS],
            )  # fmt: skip
            told = (
                "The last frame by each setting, or by some of them evenly, at the held-out value that is "
                "worst where the mean δ is best; the right column shows how far particles lie from the "
                "full-order run."
            )
            pictures.append(Picture(drawn, told, sorted({run for v in alike.values() for run in v.runs})))
    return [Section("Bodies at each setting", pictures)] if pictures else []
