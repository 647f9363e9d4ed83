"""Which charts and particle pictures a report holds, and the sentence under each."""

import operator
import os
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import pandas as pd
from joblib.externals.loky import ProcessPoolExecutor

from nsf.bodies.colors import DIFFERENCE_COLORS, STRESS_COLORS
from nsf.reporting.bodies import shapes
from nsf.reporting.drawing import charts
from nsf.reporting.keeping import Kept
from nsf.reporting.rivals import over_cost
from nsf.reporting.sections.cases import cases_section
from nsf.reporting.sections.levels import lend_stages, levels_section
from nsf.reporting.sections.settings import settings_section
from nsf.reporting.sections.variant import ENDS, ROWS, Variant, order
from nsf.reporting.sources import Study
from nsf.reporting.study import SEEDS, unseeded
from nsf.reporting.tables import (
    Merged,
    first_rows,
    mean_rows,
    natural,
    printed_of,
    variant_labels,
    variants,
)
from nsf.reporting.text.columns import MEASURED, parameter_text, speedups
from nsf.results.formats import file_name
from nsf.results.page import Picture, Section
from nsf.results.style import save

FRAMES = 31  # of an animation
BASELINE = "deformation_only"
ANIMATIONS_BYTES = 6 * 2**20  # of all on a page
# Of one on a page of many: to fit, it would give up half its frames and size, so these are never drawn.
CROWDED_BYTES, CROWDED_ANIMATED, CROWDED_FRAMES = 2**19, 1, 16
MANY = 16  # scenes and methods beyond which each has only what shows that it fails: strip and error
_FEW = 3  # variants that processes are not worth starting for
_IDLE = 60  # [s] after which one of them ends that nobody asks any more


def draw(
    merged: Merged,
    folder: Path,
    sweep: bool = False,
    study: Study | None = None,
    kept: Kept | None = None,
) -> list[Section]:
    """Draw every picture of a report into folder.

    Args:
        merged: results.
        folder: of the report.
        sweep: what varies is a number or a seed, so that bodies move alike: those of one variant a scene
            are shown, and not animated.
        study: what the report is about, which may say what the paper prints of a variant.
        kept: pictures of the report before this one, which stand where they would be drawn the same.
    """
    groups = variants(merged)
    first = first_rows(merged)
    own = zip(groups, variant_labels(first), first, strict=True)
    known = [Variant(merged, members, label, row["scene"]) for members, label, row in own]
    lend_stages(known)
    shown = _best(known, by_method=not sweep)
    drawn = _of_variants(shown, known, folder, not sweep, kept)
    sections = [
        Section(_heading(v) if len(known) > 1 else "What was simulated", pictures, key)
        for v, (key, pictures) in zip(shown, drawn, strict=True)
    ]
    return [
        *sections,
        *(settings_section(known, folder, study) if sweep and study else []),
        *levels_section(known, folder),
        *cases_section([alike for _, alike in _over_seeds(known, study)], folder),
        Section("All variants" if len(known) > 1 else "Error and cost", _comparison(known, folder, study)),
    ]


def _best(known: list[Variant], by_method: bool) -> list[Variant]:
    """Of variants of one body and method that of the smallest mean held-out δ: all would drown a page.

    One that the full-order solver ends shows that solver, and is taken only where there is no other.
    """
    best: dict[tuple, Variant] = {}
    for v in known:
        key = (*v.alike, v.method if by_method else "")
        if key not in best or order(v) < order(best[key]):
            best[key] = v
    return list(best.values())


def _baseline(v: Variant, known: list[Variant]) -> Variant | None:
    """The variant without a stress field that is shown beside one with it, if there is one."""
    if v.method != "nsf":
        return None
    found = [other for other in known if other.method == BASELINE and other.alike == v.alike]
    return min(found, key=order, default=None)


def _of_variants(
    shown: list[Variant], known: list[Variant], folder: Path, animated: bool, kept: Kept | None
) -> list[tuple[str, list[Picture]]]:
    """The pictures of each variant, and what they are made of; where they are many, by several processes."""
    gif_bytes = min(shapes.GIF_BYTES, ANIMATIONS_BYTES // len(shown)) if animated else 0
    brief = len(shown) > MANY
    prefixes = _prefixes(shown)
    beside = [_baseline(v, known) for v in shown]
    keys = [
        v.key(prefix, gif_bytes, brief, b.key() if b else "")
        for v, prefix, b in zip(shown, prefixes, beside, strict=True)
    ]
    found: dict[str, list[Picture]] = {}
    for key in keys:
        if kept is not None and (told := kept.take(key, folder)) is not None:
            found[key] = [Picture(**picture) for picture in told]
    calls = {
        key: partial(_of_variant, v, folder, prefix, gif_bytes, brief, b)
        for v, prefix, b, key in zip(shown, prefixes, beside, keys, strict=True)
        if key not in found
    }
    processes = min(os.cpu_count() or 1, len(calls))
    if processes < 2 or len(calls) <= _FEW:
        found |= {key: call() for key, call in calls.items()}
    else:
        with ProcessPoolExecutor(processes, timeout=_IDLE) as pool:
            found |= zip(calls, pool.map(operator.call, calls.values()), strict=True)
    return [(key, found[key]) for key in keys]


def _of_variant(
    v: Variant, folder: Path, prefix: str, gif_bytes: int, brief: bool, beside: Variant | None
) -> list[Picture]:
    """Bodies, then charts; no animation for 0 bytes, and of a brief one strip and error alone."""
    animation = [] if brief or not gif_bytes else _animation(v, folder, prefix, gif_bytes, beside)
    return [*animation, *_stills(v, folder, prefix, brief, beside), *_charts(v, folder, prefix, brief)]


def _animation(
    v: Variant, folder: Path, prefix: str, gif_bytes: int, beside: Variant | None
) -> list[Picture]:
    name, unit = v.parameter
    crowded = gif_bytes < CROWDED_BYTES
    cases = v.cases(CROWDED_ANIMATED if crowded else ENDS, beside)
    if not cases:
        return []
    shapes.animation(
        cases, folder / f"{prefix}animation.gif", name, unit,
        frames=CROWDED_FRAMES if crowded else FRAMES, max_bytes=gif_bytes,
    )  # fmt: skip
    cut = shapes.is_cut_open(cases[0].motion.x_full[0])
    held_out = "" if v.held_out == "train" else ", held out from training"
    caption = (
        f"The full-order model (left) and the reduced one (right) at {_told(cases, name, unit)}{held_out}"
        f"{'; the front half is cut away' if cut else ''}.{_beside(cases)}{v.continued()}"
    )
    return [Picture([f"{prefix}animation.gif"], caption, v.runs)]


def _stills(v: Variant, folder: Path, prefix: str, brief: bool, beside: Variant | None) -> list[Picture]:
    name, unit = v.parameter
    cases, continued = v.cases(ENDS, beside), v.continued()
    if not cases:
        return []
    strip = save(shapes.strip(cases, name, unit), folder, f"{prefix}strip", ("png",), [STRESS_COLORS])
    whole = "Bodies over time, cut open" if shapes.hides_stress(cases[0].motion) else "Whole bodies over time"
    told = (
        f"{whole}, at {_told(cases, name, unit)}: of each full-order above, reduced below."
        f"{_beside(cases)}{_drawn(v, cases)}{continued}"
    )
    pictures = [Picture(strip, told, v.runs)]
    if brief:
        return pictures
    cases = sorted(v.cases(ROWS), key=lambda case: natural(case.motion.parameter))
    final = save(
        shapes.final_shapes(cases, name, unit),
        folder, f"{prefix}final-shapes", ("png",), [STRESS_COLORS, DIFFERENCE_COLORS],
    )  # fmt: skip
    cut = shapes.is_cut_open(cases[0].motion.x_full[0])
    told = (
        f"The last frame of each parameter value{', the front half cut away' if cut else ''}; "
        "the right column shows how far each particle of the reduced model lies from where the "
        f"full-order one puts it.{continued}"
    )
    return [*pictures, Picture(final, told, v.runs), *_sets(v, folder, prefix)]


def _drawn(v: Variant, cases: Sequence[shapes.Case]) -> str:
    """How many particles are drawn, as a sentence; empty where all are."""
    drawn, known = cases[0].motion.x_full.shape[1], v.sources[0].particles
    return f" {drawn:,} of {known:,} particles are drawn." if drawn < known else ""


def _sets(v: Variant, folder: Path, prefix: str) -> list[Picture]:
    """S and N of the best case, where the run tells them."""
    case = v.cases(ENDS)[-1]
    if case.motion.role is None:
        return []
    drawn = save(shapes.particle_sets(case, *v.parameter), folder, f"{prefix}particle-sets", ("png",))
    told = (
        "The sample particles S and the integration particles N that a projected step of them needs, as seen "
        "through the body."
    )
    return [Picture(drawn, told, v.runs)]


def _told(cases: Sequence[shapes.Case], name: str, unit: str) -> str:
    """The cases in words, with their place among all."""
    told = [
        parameter_text(c.motion.parameter, "", unit) + (f" (the {c.place})" if c.place else "") for c in cases
    ]
    return f"{name} {' and '.join(told)}"


def _beside(cases: Sequence[shapes.Case]) -> str:
    if all(case.baseline is None for case in cases):
        return ""
    return " Beside them the baseline without a stress field, which takes τ from the deformation alone."


def _charts(v: Variant, folder: Path, prefix: str, brief: bool) -> list[Picture]:
    name, unit = v.parameter
    held_out, everything = v.series(held_out_only=True), v.series(held_out_only=False)
    pictures = []

    def add(stem: str, figure, caption: str) -> None:
        pictures.append(Picture(save(figure, folder, prefix + stem), caption, v.runs))

    add(
        "error-over-time", charts.error_over_time(held_out, name=name, unit=unit),
        "The paper's error δ and the displacement error, frame by frame; the displacement error divides by "
        f"the distance moved, so it starts high where little has moved yet.{v.continued()}",
    )  # fmt: skip
    if brief:
        return pictures
    physics = [
        c for c in ("stress_error", "linear_momentum_error", "angular_momentum_error") if _has(held_out, c)
    ]
    if physics:
        add(
            "physics-over-time", charts.error_over_time(held_out, physics, name, unit),
            "What positions do not show: errors of the Kirchhoff stress and the momenta, frame by frame.",
        )  # fmt: skip
    if "xhat_1" in held_out:
        add(
            "latent", charts.latent_trajectories(held_out, name, unit),
            "The latent path the reduced model takes (solid) and the path of the full-order frames through "
            "the encoder (dashed); dots mark the start.",
        )  # fmt: skip
    if _has(everything, "reconstruction_delta"):
        add(
            "reconstruction", charts.reconstruction_and_rollout(everything, name, unit),
            "How much error the manifold alone brings (open) and how much a rollout has in the end (filled): "
            "the distance is what the reduced dynamics add.",
        )  # fmt: skip
    if any(v.breakdown.values()):
        add(
            "runtime", charts.runtime_breakdown(v.breakdown),
            f"Where {v.timed} time goes, stage by stage; measuring takes a little time too, so that the sum "
            "may exceed the step in the table.",
        )  # fmt: skip
    return pictures


def _comparison(known: list[Variant], folder: Path, study: Study | None) -> list[Picture]:
    entries = []
    for label, alike in _over_seeds(known, study):
        rows = [
            next(row for row in mean_rows(v.merged, v.members) if row["split"] == v.held_out) for v in alike
        ]
        values = pd.concat([v.rows.loc[v.rows["split"] == v.held_out, "delta"] for v in alike])
        printed = printed_of(alike[0].merged, alike[0].members, study)
        paper = None if pd.isna(printed) else printed
        mean = pd.DataFrame(rows)[["delta", *MEASURED]].mean(skipna=False).to_dict()
        mean["shown_ms"] = mean["total_ms_reduced"] + mean["decode_ms"]
        mean |= speedups(mean)
        entries.append(mean | {"label": label, "mean": mean["delta"], "values": list(values), "paper": paper})
    runs = sorted({run for v in known for run in v.runs})
    splits = " and ".join(sorted({v.held_out for v in known}))
    of_paper = any(entry["paper"] is not None for entry in entries)
    printed = "; the paper's figure where it gives one" if of_paper else ""
    drawings: tuple[tuple[str, Callable, str], ...] = (
        ("delta", charts.delta_per_variant,
         f"Mean δ over the {splits} values, and each of them (dots){printed}."),
        ("speedup-memory", charts.speedup_and_memory,
         "Speedup of the reduced over the full-order model, of mean times (line: 1×), and the peak memory of "
         "the steps of both."),
    )  # fmt: skip
    if all(pd.isna(entry["step_ms_full"]) for entry in entries):
        drawings = drawings[:1]  # evaluation.trials=0
    pictures = [
        Picture(save(drawn(entries), folder, stem), caption, runs) for stem, drawn, caption in drawings
    ]
    return [*pictures, *over_cost(known[0].merged, folder, runs)]


def _over_seeds(known: list[Variant], study: Study | None) -> list[tuple[str, list[Variant]]]:
    """Variants whose jobs differ in seeds alone, by what their labels have in common."""
    groups: dict[object, list[Variant]] = {}
    for v in known:
        keys = study.keys.get(v.runs[0]) if study else None
        groups.setdefault(
            tuple(i for i in keys.items() if i[0] not in SEEDS) if keys else v.label, []
        ).append(v)
    found = []
    for alike in groups.values():
        if len(alike) == 1:
            found.append((alike[0].label, alike))
            continue
        parts = [unseeded(v.label) for v in alike]
        common = [part for part in parts[0] if all(part in other for other in parts)]
        found.append((" · ".join([*common, f"{len(alike)} seeds"]), alike))
    return found


def _heading(v: Variant) -> str:
    return v.label if v.label.startswith(v.body) else f"{v.body} · {v.label}"


def _prefixes(shown: list[Variant]) -> list[str]:
    """File name heads that tell the variants of a report apart; none where there is one variant."""
    if len(shown) == 1:
        return [""]
    several = len({v.body for v in shown}) > 1
    heads = [file_name(f"{v.body}-{v.method}-" if several else f"{v.method}-") for v in shown]
    return heads if len(set(heads)) == len(heads) else [f"{i}-{head}" for i, head in enumerate(heads)]


def _has(series: pd.DataFrame, column: str) -> bool:
    return column in series and bool(series[column].notna().any())
