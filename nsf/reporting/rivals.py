"""Every solver of a scene beside the others by error and by time, and the rivals that cost nothing."""

import math
from collections.abc import Iterable, Sequence
from pathlib import Path

import pandas as pd

from nsf.reporting.drawing.cost import error_over_cost, step_over_particles
from nsf.reporting.study import SEEDS, unseeded
from nsf.reporting.tables import (
    VARIANT,
    Merged,
    first_rows,
    mean_rows,
    rows_of,
    setting_without,
    variant_labels,
    variants,
    without_constants,
)
from nsf.reporting.text.columns import (
    COLUMN,
    RIVALS,
    SETTING,
    SOLVER,
    device_type,
    parameter_text,
    split_rank,
)
from nsf.results.page import Picture, Table
from nsf.results.style import save

_FULL = "full order"
_PLACE = ("scene", "precision", "device")
_TIMES = ("step_ms", "total_ms", "shown_ms", "memory_mib")
_ERRORS = ("delta", "displacement_error", "stress_error")
_NOTE = (
    "Errors are means over held-out values, and the full-order run is what they are measured from. A run is "
    "all steps from t = 0. A reduced run ends with latent vectors: the last time is that of the run and of "
    "decoding the positions of all particles at every frame, which stay on the device. A coarse solver may "
    "take longer steps, so its run has fewer of them; its time does not hold what carries its frames to the "
    "particles of the full-order run. Memory is the peak of the steps, without decoding."
)
_BESIDE = (
    "Displacement errors, means over held-out values. Nothing moves is 100 % by definition; the nearest "
    "training run is that of the nearest parameters and program, its latent vectors decoded by the same "
    "fields; latent vectors of training runs are interpolated over both; the coarse full order is the "
    "full-order solver on a coarser grid, with as many particles a cell. The first three take no step."
)


def solvers(merged: Merged) -> pd.DataFrame:
    """A row a body and solver: errors (fractions), times [ms], memory [MiB], particles; NaN if not measured.

    A body is the `scene` of `first_rows`. A variant stands once, with the means of its held-out values; the
    full-order solver, and each coarse one, once for each precision and type of device. `span_ms` is the time
    for one Δt of the full-order solver: a solver of longer steps takes fewer. `kind` is `full`, `coarse` or
    `reduced`.
    """
    groups = variants(merged)
    rows = first_rows(merged)
    labels = variant_labels([row | dict.fromkeys(_PLACE, "") for row in rows])
    places: dict[tuple, list[tuple[list[int], str]]] = {}
    for row, members, label in zip(rows, groups, labels, strict=True):
        place = (row["scene"], row["precision"], device_type(row["device"]))
        places.setdefault(place, []).append((members, label))
    rows = [
        row | {"scene": place[0]}
        for place, own in places.items()
        for row in _of_place(merged, *zip(*own, strict=True))
    ]
    return pd.DataFrame(rows)


def _of_place(merged: Merged, same: Sequence[list[int]], labels: Sequence[str]) -> list[dict]:
    """The full-order solver, coarse ones, then the variants of one scene, precision and type of device."""
    means = [mean_rows(merged, members)[0] for members in same]  # held-out values come first
    head = {name: means[0][name] for name in _PLACE} | {"particles": merged.source[same[0][0]].particles}
    cost = pd.DataFrame(means)[["step_ms_full", "total_ms_full", "memory_full_mib"]].astype(float).median()
    full = dict.fromkeys(_ERRORS, 0.0) | {SOLVER: _FULL, "kind": "full"}
    full |= {"step_ms": cost["step_ms_full"], "span_ms": cost["step_ms_full"]}
    full |= {"total_ms": cost["total_ms_full"], "shown_ms": cost["total_ms_full"]}
    full |= {"memory_mib": cost["memory_full_mib"]}
    rows = [head | full] if cost.notna().any() else []
    rows += [head | row for row in _coarse(merged, same)]
    for row, members, label in zip(means, same, labels, strict=True):
        own = {name: row[name] for name in _ERRORS} | {SOLVER: label, "kind": "reduced"}
        own |= {"step_ms": row["step_ms_reduced"], "total_ms": row["total_ms_reduced"]}
        own |= {"shown_ms": row["total_ms_reduced"] + row["decode_ms"]}
        own |= {"memory_mib": row["memory_reduced_mib"]}
        own |= {"span_ms": row["step_ms_reduced"] * _share(merged.source[members[0]].cost, "reduced")}
        rows.append(head | own)
    return rows


def _coarse(merged: Merged, same: Sequence[list[int]]) -> list[dict]:
    """Coarse full-order solvers of a scene, a row a factor: medians over what its variants' runs measured."""
    errors: dict[str, list[list[float]]] = {}
    times: dict[str, list[dict]] = {}
    for members in same:
        own: dict[str, list[float]] = {}
        split = mean_rows(merged, members)[0]["split"]
        for i in members:
            row = merged.frame.iloc[i]
            told = (merged.source[i].rivals(row["parameter"]) or {}) if row["split"] == split else {}
            for factor, found in told.get("coarse", {}).items():
                own.setdefault(factor, []).append(found.get("displacement_error", math.nan))
        for factor, values in own.items():
            errors.setdefault(factor, []).append(values)
        cost = merged.source[members[0]].cost
        for factor, found in cost.get("coarse", {}).items():
            span = found["step_ms"] * _share(cost, "coarse", factor)
            kept = {name: found[name] for name in ("step_ms", "total_ms", "memory_mib")}
            times.setdefault(factor, []).append(kept | {"shown_ms": found["total_ms"], "span_ms": span})
    rows = []
    for factor in sorted(errors, key=int):
        error = pd.Series([pd.Series(of).mean(skipna=False) for of in errors[factor]]).median()
        if not math.isnan(error):
            known = pd.DataFrame(times[factor]).median().to_dict() if factor in times else {}
            name = f"{_FULL}, Δx × {factor}"
            rows.append({SOLVER: name, "kind": "coarse", "displacement_error": error} | known)
    return rows


def _share(cost: dict, *solver: str) -> float:
    """Steps of a solver over those of the full-order one; 1 where older costs do not say."""
    own = cost
    for name in solver:
        own = own.get(name, {})
    steps = cost.get("full_order", {}).get("steps")
    return own["steps"] / steps if steps and "steps" in own else 1.0


def side_by_side(merged: Merged) -> list[Table]:
    """The table of `solvers`, without columns that say nothing; none where nothing was timed."""
    frame = solvers(merged)
    if frame[list(_TIMES)].isna().all(axis=None):
        return []
    alike = [name for name in _PLACE if frame[name].nunique() == 1]
    shown = [name for name in _TIMES if frame[name].notna().any()]
    columns = [*(name for name in _PLACE if name not in alike), SOLVER, *_ERRORS, *shown]
    return [Table("Solvers side by side", rows_of(frame[columns]), _NOTE)]


def beside_rivals(merged: Merged) -> list[Table]:
    """Displacement errors of each variant and of its rivals; none of runs that were held to no rival."""
    frame = pd.DataFrame([mean_rows(merged, members)[0] for members in variants(merged)])
    frame = frame[[*VARIANT, "displacement_error", *RIVALS]].dropna(subset=list(RIVALS), how="all")
    if not len(frame):
        return []
    shown, same = without_constants(frame.dropna(axis="columns", how="all"))
    parts = [_BESIDE, where_rivals_win(frame), *_at_single_values(merged, frame), *_refused(merged)]
    parts += [f"The same in every row: {same}."] if same else []
    return [Table("Beside rivals", rows_of(shown), " ".join(parts))]


def _at_single_values(merged: Merged, means: pd.DataFrame) -> list[str]:
    """At which values, in the mean of seeds, a rival is nearer on scenes where none is in the mean of all."""
    values = zip(merged.frame["parameter"], merged.source, strict=True)
    rows = merged.frame.assign(at=[parameter_text(value, *source.parameter) for value, source in values])
    rows = rows[~rows["scene"].isin(list(_wins(means)))]
    shown = rows.groupby("scene")["split"].transform(lambda splits: min(splits, key=split_rank))
    rows = rows[rows["split"] == shown].assign(scene=rows["scene"] + " at " + rows["at"])
    seedless = rows[SETTING].map(lambda setting: setting_without(setting, SEEDS))
    seeded = seedless != rows[SETTING]
    rows = rows.assign(setting=seedless, device=rows["device"].map(device_type))
    rows["sample"] = rows["sample"].mask(seeded, 0)  # seeds may choose samples of other sizes
    errors = rows.groupby(list(VARIANT), sort=False, dropna=False)[["displacement_error", *RIVALS]]
    won = _wins(errors.agg(lambda values: values.mean(skipna=False)).reset_index("scene"))
    over = ", in the mean of seeds," if seeded.any() else ""
    return [f"At single values{over} a rival is nearer: {'; '.join(won.values())}."] if won else []


def _refused(merged: Merged) -> list[str]:
    """Why scenes have no coarse run, a sentence each."""
    told: dict[str, None] = {}
    for row, source in zip(merged.frame.to_dict("records"), merged.source, strict=True):
        for factor, found in (source.rivals(row["parameter"]) or {}).get("coarse", {}).items():
            if "why" in found:
                told[f"{row['scene']} has no run at Δx × {factor}: {found['why']}."] = None
    return list(told)


def where_rivals_win(rows: pd.DataFrame) -> str:
    """A sentence: on which scenes a rival is nearer to the truth than the best of the rows, and by how much.

    Args:
        rows: with `scene`, `displacement_error` and the columns of rivals (fractions). A row without error is
            of the full-order solver, to which its runs were handed from the start, and does not count. A mean
            that has such runs beside others does.

    Returns:
        Nothing where no row was held to a rival.
    """
    if won := _wins(rows):
        told = "; ".join(won.values())
        return f"A rival has a smaller displacement error than the best reduced run: {told}."
    held = len(_held(rows))
    return "No rival has a smaller displacement error than the best reduced run." if held else ""


def _held(rows: pd.DataFrame) -> pd.DataFrame:
    """The rows of reduced runs that were held to a rival."""
    return rows[rows["displacement_error"] > 0.0].dropna(subset=list(RIVALS), how="all")


def _wins(rows: pd.DataFrame) -> dict[str, str]:
    """By scene, where a rival is nearer than the best row: which, and both errors."""
    told = {}
    for scene, part in _held(rows).groupby("scene", sort=False):
        own = part["displacement_error"].min()
        best = {name: part[name].min() for name in RIVALS}
        if nearer := [f"{COLUMN[name].title} ({_percent(v)})" for name, v in best.items() if v < own]:
            told[scene] = f"on {scene} {_listed(nearer)} beside {_percent(own)}"
    return told


def _percent(value: float) -> str:
    text = COLUMN["displacement_error"].text(value)
    return f"{text} %" if math.isfinite(value) else text


def _listed(texts: Iterable[str]) -> str:
    *others, last = texts
    return f"{', '.join(others)} and {last}" if others else last


def over_cost(merged: Merged, folder: Path, runs: list[str]) -> list[Picture]:
    """Error over cost, a panel a scene; none where nothing was timed."""
    frame = solvers(merged)
    if frame["span_ms"].isna().all():
        return []
    placed = [name for name in ("precision", "device") if frame[name].nunique() > 1]
    names = frame[["scene", *placed]].agg(" · ".join, axis=1)
    reduced = frame["kind"] == "reduced"
    frame.loc[reduced, SOLVER] = _common_names(frame.loc[reduced, SOLVER], names[reduced])
    panels = {name: part.to_dict("records") for name, part in frame.groupby(names, sort=False)}
    own = zip(variants(merged), first_rows(merged), strict=True)
    means = pd.DataFrame([mean_rows(merged, members)[0] | {"scene": row["scene"]} for members, row in own])
    least = means.groupby("scene")[list(RIVALS)].min()  # of nearest and interpolated, the best field's
    costless = {name: COLUMN[name].title for name in RIVALS[:3]}
    free = {
        name: {title: least.loc[of[0]["scene"], column] for column, title in costless.items()}
        for name, of in panels.items()
    }
    caption = (
        "Displacement error over time, for each solver of a scene: the full-order one (vertical line), on "
        "coarser grids (squares), and reduced ones (dots). Time is that for one Δt of the full-order solver: "
        "a solver of longer steps takes fewer. Horizontal lines are of what takes no step."
    )
    pictures = [Picture(save(error_over_cost(panels, free), folder, "error-over-cost"), caption, runs)]
    return [*pictures, *_over_particles(frame, placed, folder, runs)]


def _over_particles(
    frame: pd.DataFrame, placed: Sequence[str], folder: Path, runs: Sequence[str]
) -> list[Picture]:
    """The time of each solver over the particles of a scene, a panel a scene with several numbers of them."""
    scenes = frame["scene"].str.replace(r" · [\d,]+ particles$", "", regex=True)
    names = pd.concat([scenes, frame[list(placed)]], axis=1).agg(" · ".join, axis=1)
    panels = {
        name: {
            solver: own.groupby("particles")["span_ms"].median().to_dict()
            for solver, own in part.groupby(SOLVER, sort=False)
        }
        for name, part in frame.groupby(names, sort=False)
        if part["particles"].nunique() > 1
    }
    if not panels:
        return []
    caption = (
        "Time for one Δt of the full-order solver over the particles of the scene, for each solver. "
        "Each number of particles has a Δt and a field of its own."
    )
    drawn = save(step_over_particles(panels), folder, "step-over-particles")
    return [Picture(drawn, caption, list(runs))]


def _common_names(labels: pd.Series, panels: pd.Series) -> pd.Series:
    """Labels without seeds and the parts that some panel lacks, such as its |S|: a colour has one meaning."""
    if panels.nunique() == 1:
        return labels
    parts = labels.map(unseeded)
    known = [{part for own in of for part in own} for _, of in parts.groupby(panels)]
    common = set.intersection(*known)
    return parts.map(lambda own: " · ".join(part for part in own if part in common) or "reduced")
