"""Which charts and particle pictures a report holds, and the sentence under each."""

import operator
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
from joblib.externals.loky import ProcessPoolExecutor

from nsf.reporting.drawing import charts, shapes
from nsf.reporting.drawing.style import DIFFERENCE_COLORS, STRESS_COLORS, save
from nsf.reporting.keeping import Kept, code, key_of
from nsf.reporting.levels import lend_stages, levels_section
from nsf.reporting.rivals import over_cost
from nsf.reporting.sources import Motion, Study, same_parameter
from nsf.reporting.study import SEEDS
from nsf.reporting.tables import Merged, mean_rows, printed_of, variant_labels, variants
from nsf.reporting.text.columns import MEASURED, parameter_text
from nsf.reporting.text.formats import file_name
from nsf.reporting.text.page import Picture, Section

ROWS = 6  # parameter values in one picture of final shapes
ENDS = 2  # parameter values of strips and animations: the worst and the best
FRAMES = 31  # of an animation
BASELINE = "deformation_only"
ANIMATIONS_BYTES = 6 * 2**20  # of all on a page
# Of one on a page of many: to fit, it would give up half its frames and size, so these are never drawn.
CROWDED_BYTES, CROWDED_ANIMATED, CROWDED_FRAMES = 2**19, 1, 16
MANY = 16  # scenes and methods beyond which each has only what shows that it fails: strip and error
_FEW = 3  # variants that processes are not worth starting for
_IDLE = 60  # [s] after which one of them ends that nobody asks any more


@dataclass
class _Variant:
    """One variant's rows, with everything of its runs that pictures need."""

    merged: Merged
    members: list[int]
    label: str

    def __post_init__(self):
        self.rows = self.merged.frame.iloc[self.members]
        self.sources = [self.merged.source[i] for i in self.members]
        newest = max(self.sources, key=lambda source: (source.created, source.id))
        self.summary, self.breakdown = newest.summary, newest.cost.get("breakdown", {})
        self.timed = "a step's"  # whose time the breakdown is
        self.parameter = newest.parameter
        self.scene, self.method = self.rows["scene"].iloc[0], self.rows["method"].iloc[0]
        splits = set(self.rows["split"])
        self.held_out = next((s for s in ("test", "validation") if s in splits), self.rows["split"].iloc[0])
        shown = self.rows["split"] == self.held_out
        self.values = sorted(self.rows.loc[shown, "parameter"], key=_natural)
        self.delta = self.rows.loc[shown, "delta"].mean(skipna=False)
        self.runs = sorted({source.id for source in self.sources})

    def key(self, *how) -> str:
        """What pictures of this variant are made of, for those that are drawn so."""
        rows = [list(map(str, row)) for row in self.rows.to_numpy().tolist()]
        made = {source.id: [source.hashes, source.created] for source in self.sources}
        return key_of(
            [rows, [source.id for source in self.sources], made, self.breakdown, self.timed, how, code()]
        )

    def series(self, held_out_only: bool) -> pd.DataFrame:
        """Frames of the parameter values that this variant's rows come from, each from its own run."""
        parts = []
        for value, source in zip(self.rows["parameter"], self.sources, strict=True):
            if held_out_only and not any(same_parameter(value, v) for v in self.values):
                continue
            parts.append(source.series[[same_parameter(p, value) for p in source.series["parameter"]]])
        return pd.concat(parts, ignore_index=True)

    def continued(self) -> str:
        """Which held-out runs go on at full order, as a sentence for captions; empty where none does."""
        told, unit = [], self.parameter[1]
        for value, source in zip(self.rows["parameter"], self.sources, strict=True):
            at = (source.trust(value) or {}).get("handed_over_at")
            if at is not None and value in self.values:
                told.append(f"at {parameter_text(value, '', unit)} from {at:.3g} s on")
        return f" The full-order solver goes on {', '.join(told)}." if told else ""

    def ranked(self) -> list[tuple]:
        """Held-out values and their δ, the worst first; a run that diverged is the worst."""
        shown = self.rows["split"] == self.held_out
        deltas = self.rows.loc[shown].groupby("parameter")["delta"].mean(numeric_only=True)
        return sorted(deltas.items(), key=lambda item: -np.nan_to_num(item[1], nan=np.inf, posinf=np.inf))

    def cases(self, limit: int, baseline: "_Variant | None" = None) -> list[shapes.Case]:
        """At most `limit` held-out values, evenly from the worst to the best, which are always among them."""
        ranked = self.ranked()
        chosen = np.unique(np.linspace(0, len(ranked) - 1, min(limit, len(ranked))).round().astype(int))
        values = [ranked[i][0] for i in chosen]
        motions = {m.parameter: m for m in self._motions(values)}
        beside = {m.parameter: m for m in baseline._motions(values)} if baseline else {}
        found = []
        for i, value in zip(chosen, values, strict=True):
            if value in motions:
                place = {0: "worst", len(ranked) - 1: "best"}.get(i, "") if len(ranked) > 1 else ""
                motion, other = motions[value], beside.get(value)
                if other is not None and other.x_full.shape != motion.x_full.shape:
                    other = None  # its run kept other particles or frames
                found.append(shapes.Case(motion, place, ranked[i][1], other))
        return found

    def at(self, value, place: str) -> list[shapes.Case]:
        """The case of a held-out value, if the run kept its particles."""
        return [shapes.Case(motion, place, dict(self.ranked())[value]) for motion in self._motions([value])]

    def _motions(self, values) -> list[Motion]:
        """The particles of some held-out values, each of its own run."""
        owned: dict[str, list] = {source.id: [] for source in self.sources}
        for value, split, source in zip(
            self.rows["parameter"], self.rows["split"], self.sources, strict=True
        ):
            if split == self.held_out and value in values:
                owned[source.id].append(value)
        opened = {source.id: source for source in self.sources}
        return [motion for run, own in owned.items() for motion in opened[run].motions(own)]

    @property
    def alike(self) -> tuple[str, ...]:
        """What it is deployed on: the scene, and what was changed in it after training."""
        return self.scene, str(self.summary.get("changes") or "")


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
    labels = variant_labels([merged.frame.iloc[members[0]].to_dict() for members in groups])
    known = [_Variant(merged, members, label) for members, label in zip(groups, labels, strict=True)]
    lend_stages(known)
    shown = _best(known, by_method=not sweep)
    drawn = _of_variants(shown, known, folder, not sweep, kept)
    sections = [
        Section(_heading(v) if len(known) > 1 else "What was simulated", pictures, key)
        for v, (key, pictures) in zip(shown, drawn, strict=True)
    ]
    return [
        *sections,
        *(_at_settings(known, folder, study) if sweep and study else []),
        *levels_section(known, folder),
        Section("All variants" if len(known) > 1 else "Error and cost", _comparison(known, folder, study)),
    ]


def _at_settings(known: list[_Variant], folder: Path, study: Study) -> list[Section]:
    """The last frame of one held-out case of each scene, by every setting, or by some evenly."""
    pictures = []
    for scene in dict.fromkeys(v.scene for v in known):
        alike: dict[tuple, _Variant] = {}  # of several seeds the first
        for v in known:
            keys = study.keys.get(v.runs[0], {})
            if v.scene == scene and v.method == "nsf":
                alike.setdefault(tuple((k, str(e)) for k, e in keys.items() if k not in SEEDS), v)
        varied = {key for key, _ in set().union(*alike) - set.intersection(*map(set, alike))}
        chosen = np.unique(np.linspace(0, len(alike) - 1, min(ROWS, len(alike))).round().astype(int))
        (worst, _), *_ = min(alike.values(), key=_order).ranked()
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


def _best(known: list[_Variant], by_method: bool) -> list[_Variant]:
    """Of variants of one scene, and method, that of the smallest mean held-out δ: all would drown a page.

    One that the full-order solver ends shows that solver, and is taken only where there is no other.
    """
    best: dict[tuple, _Variant] = {}
    for v in known:
        key = (*v.alike, v.method if by_method else "")
        if key not in best or _order(v) < _order(best[key]):
            best[key] = v
    return list(best.values())


def _order(v: _Variant) -> tuple[bool, float]:
    return bool(v.continued()), v.delta if np.isfinite(v.delta) else np.inf


def _baseline(v: _Variant, known: list[_Variant]) -> _Variant | None:
    """The variant without a stress field that is shown beside one with it, if there is one."""
    if v.method != "nsf":
        return None
    found = [other for other in known if other.method == BASELINE and other.alike == v.alike]
    return min(found, key=_order, default=None)


def _of_variants(
    shown: list[_Variant], known: list[_Variant], folder: Path, animated: bool, kept: Kept | None
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
    v: _Variant, folder: Path, prefix: str, gif_bytes: int, brief: bool, beside: _Variant | None
) -> list[Picture]:
    """Bodies, then charts; no animation for 0 bytes, and of a brief one strip and error alone."""
    animation = [] if brief or not gif_bytes else _animation(v, folder, prefix, gif_bytes, beside)
    return [*animation, *_stills(v, folder, prefix, brief, beside), *_charts(v, folder, prefix, brief)]


def _animation(
    v: _Variant, folder: Path, prefix: str, gif_bytes: int, beside: _Variant | None
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


def _stills(v: _Variant, folder: Path, prefix: str, brief: bool, beside: _Variant | None) -> list[Picture]:
    name, unit = v.parameter
    cases, continued = v.cases(ENDS, beside), v.continued()
    if not cases:
        return []
    strip = save(shapes.strip(cases, name, unit), folder, f"{prefix}strip", ("png",), [STRESS_COLORS])
    whole = "Bodies over time, cut open" if shapes.hides_stress(cases[0].motion) else "Whole bodies over time"
    told = (
        f"{whole}, at {_told(cases, name, unit)}: of each full-order above, reduced below."
        f"{_beside(cases)}{continued}"
    )
    pictures = [Picture(strip, told, v.runs)]
    if brief:
        return pictures
    cases = sorted(v.cases(ROWS), key=lambda case: _natural(case.motion.parameter))
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


def _sets(v: _Variant, folder: Path, prefix: str) -> list[Picture]:
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


def _charts(v: _Variant, folder: Path, prefix: str, brief: bool) -> list[Picture]:
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


def _comparison(known: list[_Variant], folder: Path, study: Study | None) -> list[Picture]:
    entries = []
    for label, alike in _over_seeds(known, study):
        rows = [
            next(row for row in mean_rows(v.merged, v.members) if row["split"] == v.held_out) for v in alike
        ]
        values = pd.concat([v.rows.loc[v.rows["split"] == v.held_out, "delta"] for v in alike])
        printed = printed_of(alike[0].merged, alike[0].members, study)
        paper = None if pd.isna(printed) else printed
        mean = pd.DataFrame(rows)[["delta", *MEASURED]].mean(skipna=False).to_dict()
        entries.append(mean | {"label": label, "mean": mean["delta"], "values": list(values), "paper": paper})
    runs = sorted({run for v in known for run in v.runs})
    splits = " and ".join(sorted({v.held_out for v in known}))
    of_paper = any(entry["paper"] is not None for entry in entries)
    printed = "; the paper's figure where it gives one" if of_paper else ""
    drawings: tuple[tuple[str, Callable, str], ...] = (
        ("delta", charts.delta_per_variant,
         f"Mean δ over the {splits} values, and each of them (dots){printed}."),
        ("speedup-memory", charts.speedup_and_memory,
         "Speedup of the reduced over the full-order model (line: 1×), and the peak memory of both."),
    )  # fmt: skip
    if all(pd.isna(entry["step_ms_full"]) for entry in entries):
        drawings = drawings[:1]  # evaluation.trials=0
    pictures = [
        Picture(save(drawn(entries), folder, stem), caption, runs) for stem, drawn, caption in drawings
    ]
    return [*pictures, *over_cost(known[0].merged, folder, runs)]


def _over_seeds(known: list[_Variant], study: Study | None) -> list[tuple[str, list[_Variant]]]:
    """Variants whose jobs differ in seeds alone, by what their labels have in common."""
    groups: dict[object, list[_Variant]] = {}
    for v in known:
        keys = study.keys.get(v.runs[0]) if study else None
        groups.setdefault(
            tuple(i for i in keys.items() if i[0] not in SEEDS) if keys else v.label, []
        ).append(v)
    found = []
    for alike in groups.values():
        parts = [v.label.split(" · ") for v in alike]
        common = [part for part in parts[0] if all(part in other for other in parts)]
        several = [f"{len(alike)} seeds"] if len(alike) > 1 else []
        found.append((" · ".join([*common, *several]), alike))
    return found


def _heading(v: _Variant) -> str:
    return v.label if v.label.startswith(v.scene) else f"{v.scene} · {v.label}"


def _prefixes(shown: list[_Variant]) -> list[str]:
    """File name heads that tell the variants of a report apart; none where there is one variant."""
    if len(shown) == 1:
        return [""]
    scenes = len({v.scene for v in shown}) > 1
    heads = [file_name(f"{v.scene}-{v.method}-" if scenes else f"{v.method}-") for v in shown]
    return heads if len(set(heads)) == len(heads) else [f"{i}-{head}" for i, head in enumerate(heads)]


def _has(series: pd.DataFrame, column: str) -> bool:
    return column in series and bool(series[column].notna().any())


def _natural(value) -> tuple:
    return (1, 0.0, value) if isinstance(value, str) else (0, float(value), "")
