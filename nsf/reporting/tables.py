"""Tables: the results of many evaluate runs merged and averaged, with units in their headings."""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase

import pandas as pd
import rich.console
import rich.table

from nsf.reporting.sources import Source, Study, open_sources, printed_delta
from nsf.reporting.text.columns import (
    ABSENT,
    COLUMN,
    COLUMNS,
    COSTS,
    MEASURED,
    PLACE,
    RIVALS,
    SETTING,
    TEXT,
    TRAINING,
    VALUES,
    brief,
    device_type,
    distinct,
    number,
    speedups,
    split_rank,
)
from nsf.results.formats import Rows, terminal_table
from nsf.runs.columns import CASE, TITLES, cell, differing
from nsf.runs.listing import Entry

VARIANT = ("scene", "method", "field", "r", "engine", "sample", SETTING, "precision", "device")
"""The visible key of a variant; `device` counts by its type."""

PAPER = "the paper"
"""What stands as the field of a row of figures that the paper prints."""

_SHOWN = (
    "delta", "displacement_error", "stress_error", "gamma", "integration_mean",
    "speedup_step", "speedup_total", "memory_full_mib", "memory_reduced_mib",
)  # fmt: skip

_BLANK = ("engine", SETTING)
"""Columns of the key that may say nothing: of runs before there were engines, and as the scene has it."""

_NOTHING = dict.fromkeys((*VARIANT, PLACE), ABSENT) | dict.fromkeys(
    (*_SHOWN, *MEASURED, VALUES, TRAINING), math.nan
)  # of a row that the paper prints

# Columns that a terminal has no room for where they differ from row to row.
_PAGE_ONLY = [
    "integration_mean", "gamma", "step_ms_coarse", "total_ms_full", "total_ms_reduced", "total_ms_coarse",
    "decode_ms", "speedup_total", "memory_full_mib", "memory_reduced_mib", "teach_seconds", "break_even_runs",
    "handed_over", "estimated_error", "true_error", "height_error", "run_out_error", "opening_error",
    "springback_error",
]  # fmt: skip
# Those of the rest that go where a terminal of so many characters has no room, the last one first.
_SPARED, _WIDTH = ("displacement_error", "stress_error", "step_ms_reduced", "step_ms_full"), 100


#: Keys that columns of results.csv tell.
_TOLD = {CASE, "latent_dim", "sampler.size", "method", "field", "engine", "scale", "precision", "device"}
#: Keys of how a run was evaluated, and of the code: of two runs that differ in these alone the newer counts.
_PASSING = ("evaluation.", "coarse", "code.", "law.", "edited")
#: Groups of which the option may say all where it differs.
_GROUPS = ("field", "trainer", "sampler", "projector", "integration")
_MOST = 3  # keys in a setting
SIZE = ("scene.bodies.*.particles", "scene.dx", "scene.dt", "scene.steps")
"""Keys that go with the number of particles of a scene."""


@dataclass(frozen=True)
class Merged:
    """Results of many runs: `frame`, columns of results.csv and `setting`; `source`, the run of each row."""

    frame: pd.DataFrame
    source: list[Source]
    superseded: list[tuple[Source, float]]

    @property
    def csv(self) -> pd.DataFrame:
        """Content of results.csv; `setting` only where the other columns do not tell rows apart."""
        return self.frame if self.frame[SETTING].any() else self.frame.drop(columns=SETTING)


def variant_key(row) -> tuple:
    """What tells variants apart; rows that agree in it and in the parameter are the same measurement."""
    return (*(str(row[name]) for name in VARIANT[:-1]), device_type(row["device"]))


def merge(sources: list[Source], settings: Mapping[str, str] | None = None) -> Merged:
    """Join the rows of runs sorted newest first; for a variant's parameter value the newest run wins.

    Args:
        sources: runs.
        settings: by run id, what tells a run apart that no column of results.csv tells.
    """
    rows, owners, superseded, seen = [], [], [], set()
    for source in sources:
        told = {SETTING: (settings or {}).get(source.id, "")}
        for row in source.results[list(COLUMNS)].to_dict("records"):
            row |= told
            key = (*variant_key(row), _rounded(row["parameter"]))
            if key in seen:
                superseded.append((source, row["parameter"]))
                continue
            seen.add(key)
            rows.append(row)
            owners.append(source)
    order = sorted(range(len(rows)), key=lambda i: _sort_key(rows[i]))
    frame = pd.DataFrame([rows[i] for i in order], columns=[*COLUMNS, SETTING])
    text = {name: "str" for name in TEXT if name in frame}
    return Merged(frame.astype(text), [owners[i] for i in order], superseded)


def merge_results(evaluate_runs) -> pd.DataFrame:
    """One table of many evaluate runs: a row a variant and parameter value, columns exactly `COLUMNS`.

    Raises:
        MissingRunError: no run is complete.
        SchemaError: a run's file is missing or altered.
    """
    return merge(open_sources(evaluate_runs)).csv


def variants(merged: Merged) -> list[list[int]]:
    """Row numbers grouped by variant, in the frame's order."""
    groups: dict[tuple, list[int]] = {}
    for i, row in enumerate(merged.frame.to_dict("records")):
        groups.setdefault(variant_key(row), []).append(i)
    return list(groups.values())


def bodies(merged: Merged, sized: bool = True) -> Merged:
    """The same results with bodies for scenes: with material or number of particles where there are several.

    A body is `block · von_mises` or `sand · 250,000 particles`. Its `setting` tells neither again.

    Args:
        merged: results.
        sized: whether bodies of several numbers of particles are several.
    """
    own = list(zip(merged.frame["scene"], merged.source, merged.frame[SETTING], strict=True))
    materials: dict[str, set[str]] = {}
    sizes: dict[str, dict[int, set[str]]] = {}  # by scene, then number of particles: what settings tell of it
    for scene, source, setting in own:
        materials.setdefault(scene, set()).add(source.material)
        told = ", ".join(part for part in setting.split(", ") if not setting_without(part, SIZE))
        sizes.setdefault(scene, {}).setdefault(source.particles, set()).add(told)
    bodies_there, settings = [], []
    for scene, source, setting in own:
        parts, known = [scene], []
        if source.material and len(materials[scene]) > 1:
            parts, known = [*parts, source.material], ["material"]
        if sized and len(sizes[scene]) > 1:
            parts = [*parts, f"{source.particles:,} particles"]
            # What goes with the number of particles is told by it; two Δx of one number are not.
            known += SIZE if all(len(alike) == 1 for alike in sizes[scene].values()) else ()
        bodies_there.append(" · ".join(parts))
        settings.append(setting_without(setting, known))
    return replace(merged, frame=merged.frame.assign(scene=bodies_there, **{SETTING: settings}))


def first_rows(merged: Merged, sized: bool = True) -> list[dict]:
    """The first row of each variant; its `scene` is the body, of one size or, if not `sized`, of all."""
    frame = bodies(merged, sized).frame
    return [frame.iloc[i].to_dict() for i, *_ in variants(merged)]


def setting_without(setting: str, keys: Sequence[str]) -> str:
    """A setting without what it tells of some keys, which may be patterns (`scene.bodies.*.particles`)."""
    told = ((part, part.partition("=")[0]) for part in setting.split(", "))
    return ", ".join(part for part, key in told if not any(fnmatchcase(key, known) for known in keys))


def means(merged: Merged, study: Study | None = None) -> pd.DataFrame:
    """Mean over parameter values, a row a variant and split; the paper's figures follow those of its method.

    A value that was not measured or not finite leaves the mean empty: it is never averaged around. What the
    paper prints of single jobs of a study takes the place of what it prints of the scene.
    """
    groups: dict[tuple, list[list[int]]] = {}
    for members in variants(merged):
        row = merged.frame.iloc[members[0]]
        groups.setdefault((row["scene"], row["method"]), []).append(members)
    rows = []
    for same in groups.values():
        rows += [row for members in same for row in mean_rows(merged, members)]
        rows += paper_rows(merged, same, study)
    columns = [*VARIANT[:-2], "split", VALUES, *_SHOWN, TRAINING, *VARIANT[-2:], PLACE]
    return pd.DataFrame(rows, columns=columns)


def mean_rows(merged: Merged, members: list[int]) -> list[dict]:
    """The means of one variant and speedups of its mean times, a dict a split, held-out ones first."""
    part = merged.frame.iloc[members]
    seconds = merged.source[members[0]].training_seconds
    rows = []
    for split in sorted(part["split"].unique(), key=split_rank):
        chosen = part[part["split"] == split]
        row = {name: chosen[name].iloc[0] for name in VARIANT} | {"split": split, VALUES: len(chosen)}
        averaged = dict.fromkeys((*_SHOWN, *MEASURED))
        row |= {name: pd.to_numeric(chosen[name]).mean(skipna=False) for name in averaged}
        row |= speedups(row)
        rows.append(row | {TRAINING: seconds, PLACE: ABSENT})
    return rows


def paper_row(merged: Merged, members: list[int]) -> dict | None:
    """What the paper prints of a variant's scene and method, as a row of `means`; None if nothing."""
    row = merged.frame.iloc[members[0]]
    stated = (merged.source[i].summary.get("paper") or {} for i in members)
    paper: dict = next((p for p in stated if row["method"] in p), {})
    if not paper:
        return None
    return _NOTHING | paper[row["method"]] | _papers(row) | {PLACE: paper.get("place", ABSENT)}


def paper_rows(merged: Merged, same: list[list[int]], study: Study | None) -> list[dict]:
    """What the paper prints of variants of one scene and method: a row for each number of samples and δ."""
    if study is None or study.printed is None:
        return [row] if (row := paper_row(merged, same[0])) else []
    found: dict[tuple, set] = {}
    for members in same:
        row, delta = merged.frame.iloc[members[0]], printed_of(merged, members, study)
        if not math.isnan(delta):
            found.setdefault((row["sample"], delta), set()).add(row[SETTING])
    head = _NOTHING | _papers(merged.frame.iloc[same[0][0]])
    return [
        head | {"sample": sample, "delta": delta, SETTING: min(told) if len(told) == 1 else ABSENT}
        for (sample, delta), told in found.items()
    ]


def _papers(row: Mapping) -> dict:
    return {"scene": row["scene"], "method": row["method"], "field": PAPER, "split": "test"}


def printed_of(merged: Merged, members: list[int], study: Study | None) -> float:
    """δ that the paper prints of a variant, a fraction; NaN if none."""
    if study is None or study.printed is None:
        return float((paper_row(merged, members) or {}).get("delta", math.nan))
    row, job = merged.frame.iloc[members[0]], study.keys.get(merged.source[members[0]].id, {})
    return printed_delta(
        study.printed, {**job, **{name: str(row[name]) for name in ("scene", "method", "field")}}
    )


def variant_labels(rows: list[dict]) -> list[str]:
    """Short names of variants: the method, and whatever else differs among them."""
    varying = {name for name in VARIANT if len({str(row[name]) for row in rows}) > 1} | {"method"}
    form = {"field": "{} field", "r": "r {}", "engine": "{} engine", "sample": "|S| {}"}
    told = [[name for name in VARIANT if name in varying and row[name]] for row in rows]
    own = zip(rows, told, strict=True)
    return distinct([" · ".join(form.get(name, "{}").format(row[name]) for name in of) for row, of in own])


def rows_of(frame: pd.DataFrame, renamed: Mapping[str, str] | None = None) -> Rows:
    """A frame as text, with units in its headings; `renamed` ones as given."""
    known = {name: column.heading for name, column in COLUMN.items()} | dict(renamed or {})
    body = [[_cell(name, row[name]) for name in frame] for row in frame.to_dict("records")]
    return Rows([known[name] for name in frame], body, [name not in TEXT for name in frame])


def without_constants(
    frame: pd.DataFrame, also: Sequence[str] = (), keep: Sequence[str] = ("method", "parameter", "split")
) -> tuple[pd.DataFrame, str]:
    """Drop columns that describe, and those of `also`, where they say the same in every row; and empty ones.

    Rows of the paper's figures say nothing of what the paper does not print.

    Returns:
        The frame that is left, and what the dropped columns say.
    """
    describing = [name for name in (*VARIANT, "gamma", "integration_mean", "commit", *also) if name in frame]
    said = {name: {v for v in frame[name].map(str) if v not in ("", ABSENT, "nan")} for name in describing}
    computed = frame[frame["field"].ne(PAPER)] if "field" in frame else frame
    for name in _BLANK:
        if said.get(name) and computed[name].eq("").any():
            said[name].add("")  # which is another than one that is named
    for name in also:
        if said.get(name) and computed[name].isna().any():
            said[name].add("")  # what was not measured of one row is not said of it by the others
    constant = [name for name in describing if name not in keep and len(said[name]) == 1]
    empty = [name for name in (*_BLANK, PLACE) if name in frame and set(frame[name]) <= {"", ABSENT}]
    # Older runs, and those with evaluation.trials=0, have not measured everything.
    empty += [name for name in frame if name not in TEXT and frame[name].isna().all()]
    first = {name: next(v for v in frame[name] if str(v) in said[name]) for name in constant}
    told = (f"{COLUMN[n].title} {_cell(n, first[n])} {COLUMN[n].unit}".strip() for n in constant)
    return frame.drop(columns=[*constant, *empty]), ", ".join(told)


def console_table(frame: pd.DataFrame) -> rich.table.Table:
    """The results for a terminal; what never changes is in the caption, and the page has more columns.

    Where no line of 100 characters has room for the words of all columns, some go.
    """
    shown, said = without_constants(frame.drop(columns=["commit", *RIVALS], errors="ignore"), also=COSTS)
    shown, wide = shown.drop(columns=_PAGE_ONLY, errors="ignore"), rich.console.Console(width=10 * _WIDTH)
    spared = [name for name in _SPARED if name in shown]
    while spared and wide.measure(terminal_table(rows_of(shown))).minimum > _WIDTH:
        shown = shown.drop(columns=spared.pop())
    table = terminal_table(rows_of(shown), said)
    if wide.measure(terminal_table(rows_of(shown))).maximum > _WIDTH:
        for column in table.columns:  # left to itself, rich narrows the widest ones first and parts words
            column.width = max(wide.measure(text).minimum for text in (column.header, *column.cells))
    return table


def _cell(name: str, value) -> str:
    if name in TEXT:
        return ABSENT if pd.isna(value) else brief(str(value))
    if name == "parameter" and not isinstance(value, str):
        return f"{value:g}"
    return COLUMN[name].text(value) if name in COLUMN else number(value)


def _rounded(parameter):
    """Equal values written by different runs may differ in the last digits."""
    return parameter if isinstance(parameter, str) else float(f"{parameter:.6g}")


def _sort_key(row) -> tuple:
    key = map(natural, variant_key(row))
    return (row["scene"], row["method"] != "nsf", *key, split_rank(row["split"]), natural(row["parameter"]))


def natural(value) -> tuple[int, float, str]:
    """Numbers by size, then text, with the numbers in it by size."""
    try:
        return (0, float(value), "")
    except ValueError:
        return (1, 0.0, re.sub(r"\d+(\.\d+)?", lambda found: f"{float(found[0]):024.9f}", str(value)))


def told_apart(sources: Sequence[Source]) -> dict[str, str]:
    """By run id, `key=value` of what tells a run from others that are alike in every column.

    Args:
        sources: runs of one report.
    """
    alike: dict[tuple, list[Source]] = {}
    for source in sources:
        alike.setdefault(variant_key(source.results.iloc[0].to_dict() | {SETTING: ""}), []).append(source)
    found: dict[str, str] = {}
    for own in alike.values():
        known: dict = {}
        entries = [Entry(source.run, known) for source in own]
        differ = differing(entries)
        keys = [key for key in (*differ.keys, *differ.more) if key not in _TOLD]
        keys = [key for key in keys if not key.startswith(_PASSING)]
        chosen = [group for group in _GROUPS if group in keys]
        keys = [key for key in keys if key in chosen or not _said(key, chosen, entries)][:_MOST]
        # Keys of a law that others lack do not differ, and the class of one is no key.
        several = len({source.material for source in own}) > 1
        for source, entry in zip(own, entries, strict=True):
            told = [f"material={source.material}"] if several else []
            told += [f"{key}={cell(entry, key)}" for key in sorted(keys, key=_rank)]
            if told:
                found[entry.run.id] = ", ".join(told)
    return found


def _said(key: str, chosen: Sequence[str], entries: Sequence[Entry]) -> bool:
    """Whether the option of a key's group says the key's value in every run."""
    group = key.partition(".")[0]
    if group not in chosen:
        return False
    pairs = {(cell(entry, group), cell(entry, key)) for entry in entries}
    return len(pairs) == len({option for option, _ in pairs})


def _rank(key: str) -> tuple[int, str]:
    return list(TITLES).index(key) if key in TITLES else len(TITLES), key
