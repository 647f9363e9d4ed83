"""What the report of a study tells beyond its variants: what is varied, and trust."""

import math
from collections.abc import Mapping, Sequence
from fnmatch import fnmatchcase
from pathlib import Path

import numpy as np
import pandas as pd

from nsf.reporting.drawing import charts
from nsf.reporting.sources import Study
from nsf.reporting.tables import (
    SIZE,
    Merged,
    first_rows,
    paper_row,
    printed_of,
    rows_of,
    setting_without,
    variant_labels,
    variants,
)
from nsf.reporting.text.columns import COLUMN, axis, counted, distinct, number, plus_minus, telling
from nsf.results.formats import Rows
from nsf.results.page import Picture, Section, Table
from nsf.results.style import save

_SCENE, _RUN, _PAPER = "scene", "run", "the paper's δ"
SEEDS = ("seed", "sampler.seed")
_ERRORS = ("delta", "displacement_error", "stress_error")
AXES = {
    "sampler.size": ("sample particles |S|", "–", "sample"),
    "sampler.cells": ("cells with sample particles", "–", None),
    "latent_dim": ("latent coordinates r", "–", "r"),
    "field.beta": ("hidden width β over d", "–", None),
    "scene.bodies.column.particles": ("particles", "–", None),
    "scene.design.train": ("training runs", "–", None),
    "deploy.dt_multiplier": ("deployment step", "full-order Δt", None),
    "trainer.steps": ("training steps of each network", "–", None),
}
"""Keys that are an axis: its title and unit, and the column of results.csv that tells what became of it."""
TRAIN = "scene.design.train"  # a list, of which the length is shown
_STEPS, _SECONDS = "trainer.steps", ("training time", "s")  # shown in place of steps where runs tell it

_MUTE = ("null", "paper")  # values that say nothing, or something else, without their key
_RENAMED = {
    "method": "variant",
    "trust": "distrust ratio",
    "distrusted_at": "first distrusted [s]",
    "handed_over_at": "full order from [s]",
}
_DRAWS = 10_000  # of seeds and held-out values, for the interval of a mean
_FEWEST = 3  # rows of which a rank correlation says anything
_ESTIMATED = 5  # of runs by operators, whose true error has that of projected runs in it


def unseeded(label: str) -> list[str]:
    """The parts of a variant's label, without what they tell of seeds."""
    parts = (setting_without(part, SEEDS) for part in label.split(" · "))
    return [part for part in parts if part]


def swept(merged: Merged, study: Study, folder: Path) -> list[Section]:
    """Draw δ over each number that the jobs vary; over the seeds where they vary nothing else.

    Args:
        merged: results.
        study: whose jobs they are.
        folder: of the report.
    """
    frame = _held_out(merged, study)
    varied = [key for key in frame.columns if key in (*AXES, *SEEDS) and frame[key].nunique() > 1]
    pictures = [_over(key, frame, merged, study, folder) for key in varied if key in AXES]
    if not pictures and varied:
        pictures = [_scatter(frame, merged, folder)]
    return [Section("What is varied", pictures)] if pictures else []


def _held_out(merged: Merged, study: Study) -> pd.DataFrame:
    """One row a job and held-out value: the job's keys, its run, δ, the paper's, and the row of `merged`.

    The scene is that of `first_rows`, with its material where there are several.
    """
    groups = list(zip(variants(merged), first_rows(merged, sized=False), strict=True))
    printed = {i: printed_of(merged, members, study) for members, _ in groups for i in members}
    body = {i: first["scene"] for members, first in groups for i in members}
    rows = [
        {_SCENE: body[i]}
        | {key: value for key, value in study.keys.get(source.id, {}).items() if key != _SCENE}
        | {_RUN: source.id, "delta": row["delta"], _PAPER: printed[i], "row": i}
        for i, (row, source) in enumerate(zip(merged.frame.to_dict("records"), merged.source, strict=True))
        if row["split"] != "train"
    ]
    frame = pd.DataFrame(rows)
    return frame.assign(**{TRAIN: counted(frame[TRAIN], frame[_SCENE])}) if TRAIN in frame else frame


def _over(key: str, frame: pd.DataFrame, merged: Merged, study: Study, folder: Path) -> Picture:
    """δ over one key, a panel a scene, a line for each setting of the other keys.

    In place of training steps stands their time, the mean over seeds, where every run tells it; then jobs
    that set no steps have a place, too. Over training runs there is a line for interpolating them.
    """
    title, unit, column = AXES[key]
    shown = frame[frame[key].notna()]
    source = merged.frame[column].loc[shown["row"]].array if column else shown[key]
    if key == _STEPS:
        seconds = [merged.source[row].training_seconds for row in frame["row"]]
        if None not in seconds:
            shown = frame
            alike = shown.columns.drop([*SEEDS, _RUN, "delta", "row"], errors="ignore")
            alike = [shown[name] for name in alike]
            (title, unit), of_rows = _SECONDS, pd.Series(seconds, shown.index)
            source = of_rows.groupby(alike, dropna=False).transform("mean")
    shown = shown.assign(x=pd.to_numeric(pd.Series(source, index=shown.index), errors="coerce"))
    panels, papers, interpolated, scheduled = {}, {}, False, bool(shown[key].isna().any())
    devices = merged.frame["device"].loc[shown["row"]].unique() if title == _SECONDS[0] else ()
    placed = shown.dropna(subset="x")
    hidden = (key, *SEEDS, *(SIZE if fnmatchcase(key, SIZE[0]) else ()))
    told = _told(placed, hidden, beside=(_SCENE,))
    for scene, part in placed.groupby(_SCENE, sort=False):
        panels[scene] = {
            name: group.groupby("x")["delta"].apply(list).to_dict()
            for name, group in _settings(part, told, alone="reduced" if key == TRAIN else "mean")
        }
        if key == TRAIN:
            panels[scene] |= _interpolated(merged, part)
            interpolated |= "interpolated latents" in panels[scene]
        if study.printed is not None:
            papers[scene] = part[["x", _PAPER]].dropna().drop_duplicates().to_numpy().tolist()
        else:
            printed = paper_row(merged, [part["row"].iloc[0]]) or {}
            paper = [pd.to_numeric(printed.get(name), errors="coerce") for name in (column, "delta")]
            papers[scene] = [] if any(map(pd.isna, paper)) else [paper]
    seeds = any(shown[seed].nunique() > 1 for seed in SEEDS if seed in shown)
    figure = charts.delta_over(panels, axis(title, unit), papers)
    caption = (
        f"Mean δ (line) against {title}, and from the smallest to the largest over the held-out values"
        f"{' and seeds' if seeds else ''} (band). Where a run diverged, the line has a gap."
        + (" A job that sets no steps takes those of its trainer." if scheduled else "")
        + (f" Times are of {' and '.join(devices)}, as the table says." if len(devices) > 1 else "")
        + (" The cross is what the paper prints." if any(papers.values()) else "")
        + (" Interpolating the latent vectors of the training runs takes no step." if interpolated else "")
    )
    stem = f"delta-over-{key.replace('.', '-').replace('_', '-')}"
    return Picture(save(figure, folder, stem), caption, sorted(set(shown[_RUN])))


def _interpolated(merged: Merged, part: pd.DataFrame) -> dict[str, dict[float, list[float]]]:
    """δ of interpolated latents at each x of rows of `_held_out`; nothing where they were not measured.

    Both errors of a run divide the same distance, one by the positions and one by the displacements, so their
    ratio is that of the full-order run, whichever reduced run tells it.
    """
    rows = merged.frame.loc[part["row"]].reset_index(drop=True)
    ratio = (rows["delta"] / rows["displacement_error"]).astype(float)
    ratio = ratio.groupby([rows["gamma"] * rows["r"], rows["parameter"]]).transform("median")
    delta = rows["displacement_interpolated"].astype(float) * ratio
    if not np.isfinite(delta).all():
        return {}
    return {"interpolated latents": delta.groupby(part["x"].to_numpy()).apply(list).to_dict()}


def _scatter(frame: pd.DataFrame, merged: Merged, folder: Path) -> Picture:
    """Mean δ of each seed, a row for each setting of the other keys."""
    entries = []
    for seed in SEEDS:
        part = frame[frame[seed].notna()] if seed in frame else frame.iloc[:0]
        for name, group in _settings(part, _told(part, SEEDS), alone=merged.frame["scene"].iloc[0]):
            values = group.groupby(seed)["delta"].apply(lambda deltas: deltas.mean(skipna=False))
            printed = group[_PAPER].iloc[0]
            told = {"mean": values.mean(skipna=False), "values": list(values)}
            paper = None if pd.isna(printed) else printed
            entries.append({"label": f"{name} · {len(values)} × {seed}", "paper": paper} | told)
    caption = (
        "δ, averaged over the held-out values, for each seed (dots): seed is of the networks' first weights "
        "and batches, sampler.seed of the sample particles; and their mean"
        + (", and what the paper prints." if any(entry["paper"] is not None for entry in entries) else ".")
    )
    figure = charts.delta_per_variant(entries, dots="one seed")
    return Picture(save(figure, folder, "delta-over-seeds"), caption, sorted(set(frame[_RUN])))


def over_seeds(merged: Merged, study: Study) -> list[Table]:
    """Mean and deviation of errors over the seeds of jobs that differ in nothing else; an interval of δ."""
    frame, body = _held_out(merged, study), []
    for seed in SEEDS:
        part = frame[frame[seed].notna()] if seed in frame else frame.iloc[:0]
        for name, group in _settings(part, _told(part, SEEDS), alone=merged.frame["scene"].iloc[0]):
            if group[seed].nunique() < 2:
                continue
            rows = merged.frame.loc[group["row"]].assign(seed=group[seed].array)
            means = rows.groupby("seed")[list(_ERRORS)].agg(lambda values: values.mean(skipna=False))
            cells = (
                plus_minus(means[e].mean(skipna=False), means[e].std(skipna=False), COLUMN[e].scale)
                for e in _ERRORS
            )
            deltas = rows.pivot_table("delta", "seed", "parameter", dropna=False).to_numpy()
            body.append([name, seed, f"{len(means)}", *cells, _between(interval(deltas))])
    if not body:
        return []
    headings = ["of", "varied", "seeds", *(COLUMN[e].heading for e in _ERRORS), "mean δ, 95 % [%]"]
    note = (
        "Of each seed the mean over held-out values: shown is their mean ± their standard deviation. "
        "Between the ends in the last column lies the mean δ of 95 % of "
        f"{_DRAWS:,} draws of seeds and of held-out values, both with replacement."
    )
    return [Table("Over seeds", Rows(headings, body, [i > 1 for i in range(len(headings))]), note)]


def interval(values: np.ndarray) -> tuple[float, float]:
    """The middle 95 % of the means of `values` [seeds, held-out values], both drawn anew with replacement.

    NaN where a value is missing or a run diverged. The draws are the same at each call.

    Source: the percentile bootstrap, Efron and Tibshirani 1993, chapter 13, of rows and of columns.
    """
    if not np.isfinite(values).all():
        return np.nan, np.nan
    generator = np.random.default_rng(0)
    rows, columns = (generator.integers(n, size=(_DRAWS, n)) for n in values.shape)
    means = values[rows[:, :, None], columns[:, None, :]].mean((1, 2))
    low, high = np.quantile(means, (0.025, 0.975))
    return float(low), float(high)


def _between(ends: tuple[float, float]) -> str:
    """Both ends of an interval of shares, in percent."""
    return " to ".join(number(end, 100) for end in ends) if np.isfinite(ends).all() else "–"


def _told(frame: pd.DataFrame, without: Sequence[str], beside: Sequence[str] = ()) -> list[str]:
    """Keys of the jobs that, beside others, tell rows of `_held_out` apart; `without` are no setting."""
    keys = frame.columns.drop([_RUN, "delta", _PAPER, "row", "x", *without, *beside], errors="ignore")
    return telling(frame.to_dict("records"), keys, beside)


def _settings(frame: pd.DataFrame, told: Sequence[str], alone: str) -> list[tuple[str, pd.DataFrame]]:
    """The rows of each setting, by a name of the keys that tell settings apart.

    Args:
        frame: rows of `_held_out`.
        told: these keys.
        alone: the name of all rows where there are none, and of rows that have none of them.
    """
    if not told:
        return [(alone, frame)] if len(frame) else []
    groups = list(frame.groupby(told, dropna=False, sort=False))
    settings = [dict(zip(told, values, strict=True)) for values, _ in groups]
    names = distinct([_name(setting) for setting in settings])
    return [(name or alone, group) for name, (_, group) in zip(names, groups, strict=True)]


def _name(setting: Mapping[str, object]) -> str:
    """Values of a setting, those that say nothing alone after their key; none twice, as a body's material."""
    parts: dict[str, None] = {}
    for key, value in setting.items():
        if pd.isna(value):
            continue
        text = str(value)
        if text in _MUTE or text.startswith("[") or not pd.isna(pd.to_numeric(text, errors="coerce")):
            title = AXES[key][0] if key in AXES else key.rpartition(".")[2].replace("_", " ")
            text = f"{title} {text}"
        parts |= dict.fromkeys(text.split(" · "))
    return " · ".join(parts)


def trust_table(merged: Merged, renamed: Mapping[str, str]) -> list[Table]:
    """How far each reduced run went from its training data, beside its true error; none where no run tells.

    Args:
        merged: results; the parameter, ratio, times [s] and true δ of each row whose run tells them.
        renamed: headings of columns that this page calls otherwise.
    """
    rows = []
    for i, label in enumerate(variant_labels(merged.frame.to_dict("records"))):
        row, told = merged.frame.iloc[i], merged.source[i].trust(merged.frame["parameter"].iloc[i])
        if told is None:
            continue
        ratio = math.inf if told["trust"] is None else told["trust"]
        times = {name: _or_nan(told[name]) for name in ("distrusted_at", "handed_over_at")}
        known = {name: row[name] for name in ("parameter", "split")}
        errors = {name: row[name] for name in ("estimated_error", "true_error")}
        errors["handed_over"] = row["handed_over"]
        rows.append({"method": label, **known, "trust": ratio, **times, "delta": row["delta"], **errors})
    if not rows:
        return []
    frame = pd.DataFrame(rows)
    same, estimated = frame["method"].nunique() == 1, frame["estimated_error"].notna().any()
    unseen = [] if estimated else ["estimated_error", "true_error"]
    shown = frame.drop(columns=[*unseen, "handed_over", *(["method"] if same else [])])
    note = " ".join(filter(None, (trust_note(frame), estimate_note(frame))))
    return [Table("Trust", rows_of(shown, {**renamed, **_RENAMED}), note)]


def estimate_note(rows: pd.DataFrame) -> str:
    """How the estimate of runs by operators agrees with their true error; empty where there are too few.

    Args:
        rows: `estimated_error` and `true_error` [m], and `handed_over`, the share of the steps that operators
            did not take.
    """
    known = rows[rows["estimated_error"].notna() & (rows["handed_over"] < 1.0)]
    if len(known) < _ESTIMATED:
        return ""
    agreement = spearman(known["estimated_error"], known["true_error"])
    return (
        "The estimated error is how far a run by operators goes from one by projected steps, RMS over the "
        "samples, as single projected steps tell. The true one is how far it goes from the full-order run, "
        "RMS over all particles, with the error of the projected steps in it. Both are the largest of a run. "
        f"Spearman's rank correlation of the two over {len(known)} runs is {agreement:.2f}."
    )


def trust_note(rows: pd.DataFrame) -> str:
    """The meaning of the ratio, and how its ranks agree with those of δ."""
    said = (
        "The distrust ratio is the largest of a run's steps: how far it went from the training data, by the "
        "residual of its projections, by its latent vector or, beyond 1, by its parameters, where "
        "1 is as far as training data are from themselves. It needs no full-order run; a ratio above 1 says "
        "not to believe what follows."
    )
    # The rest of a run that was handed over is the full-order solver's, and so is its error.
    reduced = rows[rows["handed_over_at"].isna()]
    if len(reduced) < _FEWEST:
        return said
    agreement = spearman(reduced["trust"], reduced["delta"])
    return (
        f"{said} Over the {len(reduced)} reduced runs of this table its Spearman rank correlation with the "
        f"true {COLUMN['delta'].title} is {agreement:.2f}."
    )


def spearman(a: pd.Series, b: pd.Series) -> float:
    """Spearman's rank correlation: the correlation of ranks, in which ∞ is a value like any other."""
    return float(a.rank().corr(b.rank()))


def _or_nan(value: float | None) -> float:
    return math.nan if value is None else value
