"""How δ depends on what an experiment varies: a number, or nothing but seeds."""

from collections.abc import Sequence
from pathlib import Path

import pandas as pd

from nsf.reporting import charts
from nsf.reporting.columns import axis
from nsf.reporting.pictures import Picture, Section
from nsf.reporting.study import Study
from nsf.reporting.style import save
from nsf.reporting.tables import Merged, paper_row, printed_of, variants

_SCENE, _RUN, _PAPER = "scene", "run", "the paper's δ"
SEEDS = ("seed", "sampler.seed")
AXES = {
    "sampler.size": ("sample particles |S|", "–", "sample"),
    "latent_dim": ("latent coordinates r", "–", "r"),
    "field.beta": ("hidden width β over d", "–", None),
    "deploy.dt_multiplier": ("deployment step", "full-order Δt", None),
}
"""Keys that are an axis: its title and unit, and the column of results.csv that tells what became of it."""


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
    """One row a job and held-out value: the job's keys, its run, δ, the paper's, and the row of `merged`."""
    printed = {i: printed_of(merged, members, study) for members in variants(merged) for i in members}
    rows = [
        {_SCENE: row["scene"]}
        | study.keys.get(source.id, {})
        | {_RUN: source.id, "delta": row["delta"], _PAPER: printed[i], "row": i}
        for i, (row, source) in enumerate(zip(merged.frame.to_dict("records"), merged.source, strict=True))
        if row["split"] != "train"
    ]
    return pd.DataFrame(rows)


def _over(key: str, frame: pd.DataFrame, merged: Merged, study: Study, folder: Path) -> Picture:
    """δ over one key, a panel a scene, a line for each setting of the other keys."""
    title, unit, column = AXES[key]
    shown = frame[frame[key].notna()]
    source = merged.frame[column].loc[shown["row"]].array if column else shown[key]
    shown = shown.assign(x=pd.to_numeric(pd.Series(source, index=shown.index), errors="coerce"))
    panels, papers = {}, {}
    by_scene = list(shown.dropna(subset="x").groupby(_SCENE, sort=False))
    told = list(dict.fromkeys(name for _, part in by_scene for name in _told(part, (key, *SEEDS))))
    for scene, part in by_scene:
        panels[scene] = {
            name: group.groupby("x")["delta"].apply(list).to_dict()
            for name, group in _settings(part, told, alone="mean")
        }
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
        + (" The cross is what the paper prints." if any(papers.values()) else "")
    )
    stem = f"delta-over-{key.replace('.', '-').replace('_', '-')}"
    return Picture(save(figure, folder, stem), caption, sorted(set(shown[_RUN])))


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
        "and batches, sampler.seed of the sample particles; their mean, and what the paper prints."
    )
    figure = charts.delta_per_variant(entries, dots="one seed")
    return Picture(save(figure, folder, "delta-over-seeds"), caption, sorted(set(frame[_RUN])))


def _told(frame: pd.DataFrame, without: Sequence[str]) -> list[str]:
    """Keys of the jobs that tell the settings in rows of `_held_out` apart; `without` are no setting."""
    told: list[str] = []
    groups = 1
    for key in frame.columns.drop([_RUN, "delta", _PAPER, "row", "x", *without], errors="ignore"):
        found = frame.groupby([*told, key], dropna=False).ngroups
        if found > groups:
            told, groups = [*told, key], found
    return told


def _settings(frame: pd.DataFrame, told: Sequence[str], alone: str) -> list[tuple[str, pd.DataFrame]]:
    """The rows of each setting, by a name of the keys that tell settings apart.

    Args:
        frame: rows of `_held_out`.
        told: these keys.
        alone: the name of all rows where there are none.
    """
    if not told:
        return [(alone, frame)] if len(frame) else []
    return [
        (" · ".join(str(value) for value in values if not pd.isna(value)), group)
        for values, group in frame.groupby(told, dropna=False, sort=False)
    ]
