"""What a finished report comes to: one small table, and what is to be said of it."""

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd

from nsf.reporting.rivals import where_rivals_win
from nsf.reporting.study import AXES
from nsf.reporting.summary import (
    DEVIATION,
    DIVERGED,
    MEASURED,
    PAPER,
    RUNS,
    SEED_COUNT,
    SHARE,
    WORST,
    Report,
    own_keys,
    ranked,
)
from nsf.reporting.text.columns import ABSENT, COLUMN, axis, brief, number, parameter_text, plus_minus
from nsf.results.formats import Rows

FEW = 15  # rows of a table in which a number is varied; of more, settings and scenes go down and across
MANY = 24  # rows where none is, as in the paper's Table 1
_BASELINE = "deformation_only"
_SPLITS = ({"train"}, {"validation"})
_NUMBERS = {column or key for key, (_, _, column) in AXES.items()}
_TITLES = {key: axis(title, unit.strip("–")) for key, (title, unit, _) in AXES.items()}


def headline(report: Report) -> tuple[Rows, str]:
    """The table, and what is to be said of it."""
    varied = [key for key in report.settings if key in _NUMBERS]
    if not report.settings and report.seeds:
        said = f"Shown: of each seed the mean over {_values(report)} values; ± their deviation over seeds."
        # The paper's figure stands in each row.
        return _over_seeds(report), f"{said}{_rivals(report)}{_diverged(report)}"
    if len(report.groups) <= (FEW if varied else MANY):
        table, said = _flat(report), f"Shown: {_averaged(report)}.{_defaults(report)}"
    else:
        table = _pivot(report, varied)
        share = ", and N in % of all particles" if SHARE in _bracketed(report) else ""
        said = f"Shown: δ [%], in brackets the stress error [%]{share}; {_averaged(report)}.{_best(report)}"
    return table, f"{said}{_beside_paper(report)}{_rivals(report)}{_diverged(report)}"


def _flat(report: Report) -> Rows:
    """A row a scene and setting, with every measure."""
    groups = report.groups
    order = dict.fromkeys(("scene", "method", "field", "engine", *report.settings, "r", "sample"))
    shown = [key for key in order if key == "scene" or groups[key].nunique() > 1]
    hidden = {WORST} if (groups[RUNS] == 1).all() else set()
    hidden |= set() if groups["handed_over"].any() else {"handed_over"}
    measured = [name for name in MEASURED if name not in hidden and groups[name].notna().any()]
    seeds = [SEED_COUNT] if groups[SEED_COUNT].nunique() > 1 else []
    paper = ["paper's δ [%]"] if groups[PAPER].notna().any() else []
    body = [
        [_text(key, row[key]) for key in shown]
        + [f"{row[name]}" for name in seeds]
        + [number(row[PAPER], 100) for _ in paper]
        + [
            plus_minus(row[name], row.get(f"{name}{DEVIATION}", np.nan), COLUMN[name].scale)
            for name in measured
        ]
        for row in groups.to_dict("records")
    ]
    headings = [*map(_title, shown), *seeds, *paper, *(COLUMN[name].heading for name in measured)]
    numeric = [*map(_is_number, shown), *(True for _ in (*seeds, *paper, *measured))]
    return Rows(headings, body, numeric)


def _pivot(report: Report, varied: Sequence[str]) -> Rows:
    """Mean δ and what stands in brackets, settings down and scenes across, or as it takes fewer rows."""
    groups, settings, bracketed = report.groups, report.settings, _bracketed(report)
    kinds = _kinds(groups, settings)
    if groups["scene"].nunique() > kinds:
        down, across = ["scene"], settings
    elif kinds <= FEW or not varied:
        down, across = settings, ["scene"]
    else:
        down, across = [varied[0]], ["scene", *(key for key in settings if key != varied[0])]
    found = {
        (tuple(row[k] for k in down), tuple(row[k] for k in across)): row for row in groups.to_dict("records")
    }
    columns = _sorted(groups, across)
    printed = {at for (_, at), row in found.items() if not np.isnan(row[PAPER])}
    headings = [_title(key) for key in down]
    for at in columns:
        name = _told(across, at)
        headings += [name, f"{name}, the paper"] if at in printed else [name]
    body = []
    for values in _sorted(groups, down):
        body.append([_text(key, value) for key, value in zip(down, values, strict=True)])
        for at in columns:
            row = found.get((values, at))
            body[-1].append(_with_brackets(row, bracketed) if row else "")
            if at in printed:
                body[-1].append(number(row[PAPER], 100) if row else "")
    numeric = [*map(_is_number, down), *(True for _ in headings[len(down) :])]
    return Rows(headings, body, numeric)


def _bracketed(report: Report) -> list[str]:
    """What stands beside δ: the stress error and, where samples are compared, the share of N."""
    sampled = any(key == "sample" or key.startswith("sampler") for key in report.settings)
    return ["stress_error", *([SHARE] if sampled else [])]


def _with_brackets(row: Mapping, bracketed: Sequence[str]) -> str:
    """δ and other means of a row of `groups`, or how many of its runs diverged."""
    if row[DIVERGED]:
        return f"{row[DIVERGED]} of {row[RUNS]} diverged"
    delta = plus_minus(row["delta"], row.get(f"delta{DEVIATION}", np.nan), 100)
    return f"{delta} ({', '.join(number(row[name], 100) for name in bracketed)})"


def _over_seeds(report: Report) -> Rows:
    """δ of the seeds of each scene, a row for training and one for the sample."""
    body = []
    for seed in report.seeds:
        for scene, part in report.rows[report.rows[seed].notna()].groupby("scene", sort=False):
            delta = part.groupby(seed)["delta"].agg(lambda values: values.mean(skipna=False))
            mean = plus_minus(delta.mean(skipna=False), delta.std(skipna=False), 100)
            told = (delta.min(skipna=False), delta.max(skipna=False), part[PAPER].mean(skipna=False))
            body.append([scene, seed, f"{len(delta)}", mean, *(number(value, 100) for value in told)])
    headings = ["scene", "varied", "seeds", "mean δ [%]", "smallest [%]", "largest [%]", "paper's δ [%]"]
    if report.rows[PAPER].isna().all():
        headings, body = headings[:-1], [row[:-1] for row in body]
    return Rows(headings, body, [i > 1 for i in range(len(headings))])


def _averaged(report: Report) -> str:
    """What the numbers are means over."""
    alone = "parameter" in report.settings
    told = f"each {_values(report)} value by itself" if alone else f"means over {_values(report)} values"
    if not report.seeds:
        return f"{told}, of one seed"
    return f"{told} and, where several were run, seeds (± their standard deviation)"


def _values(report: Report) -> str:
    """Which parameter values the rows are of."""
    splits = set(report.rows["split"])
    return (
        {"train": "training", "validation": "validation"}[splits.pop()] if splits in _SPLITS else "held-out"
    )


def _best(report: Report) -> str:
    """The smallest δ of each scene, and where."""
    told = []
    for scene, part in report.groups.groupby("scene", sort=False):
        finite = part[np.isfinite(part["delta"])]
        if len(finite):
            row = finite.loc[finite["delta"].idxmin()]
            where = _told(report.settings, [row[key] for key in report.settings], ", ")
            told.append(f"{number(row['delta'], 100)} % on {scene} ({where})")
    return f" Smallest δ: {'; '.join(told)}." if told else ""


def _beside_paper(report: Report) -> str:
    """In how many rows δ is below the paper's, and on which scenes that of a still body is in all of them.

    The baseline does not count. Small runs cannot be compared, and that is said.
    """
    known = report.groups.dropna(subset=PAPER)
    if not len(known):
        return ""
    if report.small:
        return f" The paper's δ is of its full size, these runs are of {min(report.small)} scale."
    known, told = known[known["method"] != _BASELINE], []
    if not len(known):
        return ""
    for (method, field), part in known.groupby(["method", "field"], sort=False):
        below = int((part["delta"] < part[PAPER]).sum())
        told.append(f"{below} of {len(part)} ({method}, {field})")
    still = (known["delta_static"] < known[PAPER]).groupby(known["scene"], sort=False).all()
    scenes = ", ".join(still.index[still])
    also = f" A body that never moves has a smaller δ than the paper's on {scenes}." if scenes else ""
    return f" δ is below the paper's in {', '.join(told)} of the rows for which the paper prints one.{also}"


def _defaults(report: Report) -> str:
    """Under which configuration keys cells are empty, since a job does not set them or sets null."""
    keys = {key for run in report.told["runs"].values() for key in own_keys(run)}
    bare = [_title(key) for key in report.settings if key in keys and (report.groups[key] == ABSENT).any()]
    return f" Where a job does not set {', '.join(bare)}, or sets null, a cell has –." if bare else ""


def _rivals(report: Report) -> str:
    rows = report.groups
    if "parameter" in report.settings:  # each value by itself
        rows = rows.assign(scene=rows["scene"] + " at " + rows["parameter"].map(parameter_text))
    told = where_rivals_win(rows)
    return f" {told}" if told else ""


def _diverged(report: Report) -> str:
    count = int(np.isinf(report.rows["delta"]).sum())
    return f" ∞: {count} of the {len(report.rows)} reduced runs diverged." if count else ""


def _kinds(rows: pd.DataFrame, columns: Sequence[str]) -> int:
    return len(rows.drop_duplicates(list(columns))) if columns else 0


def _sorted(groups: pd.DataFrame, keys: Sequence[str]) -> list[tuple]:
    """The combinations of values that are there, by the keys in turn."""
    ranks = [ranked(groups[key]) for key in keys]
    known = dict.fromkeys(groups[list(keys)].itertuples(index=False, name=None))
    return sorted(known, key=lambda values: [rank[v] for rank, v in zip(ranks, values, strict=True)])


def _title(key: str) -> str:
    return COLUMN[key].title if key in COLUMN else _TITLES.get(key, key.rpartition(".")[2].replace("_", " "))


def _text(key: str, value) -> str:
    """A setting in a cell; of a mapping of dotted keys the last part of each."""
    if not isinstance(value, str):
        return parameter_text(value)
    if not value.startswith("{"):
        return brief(value)
    entries = (entry.partition(":") for entry in value.strip("{}").split(","))
    return ", ".join(f"{name.rpartition('.')[2]} {changed}" for name, _, changed in entries)


def _named(key: str, value) -> str:
    """A setting away from its heading: numbers need their title."""
    text = _text(key, value)
    return f"{_title(key)} {text}" if _is_number(key) else text


def _told(keys: Sequence[str], values: Sequence, separator: str = " · ") -> str:
    """Settings away from their headings; where none is set, those of the scene's yaml hold."""
    named = [_named(key, value) for key, value in zip(keys, values, strict=True) if value != ABSENT]
    return separator.join(named) or "as the scene has it"


def _is_number(key: str) -> bool:
    return key in _NUMBERS or key == "parameter"
