"""What a finished report comes to, in one small table: from its results.csv and sources.json alone."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import pandas as pd

from nsf.errors import SchemaError
from nsf.reporting.rivals import where_rivals_win
from nsf.reporting.sources import printed_delta
from nsf.reporting.study import AXES, SEEDS, TRAIN
from nsf.reporting.text.columns import (
    ABSENT,
    COLUMN,
    LATER,
    RIVALS,
    TEXT,
    axis,
    brief,
    counted,
    number,
    parameter_text,
    plus_minus,
    speedups,
    telling,
)
from nsf.reporting.text.formats import Rows

FEW = 15  # rows of a table in which a number is varied; of more, settings and scenes go down and across
MANY = 24  # rows where none is, as in the paper's Table 1
_VALUES = "scene.design.test"  # jobs of one scene and seed with this key are about single held-out values
_PAPER = "paper"
_BASELINE = "deformation_only"
_DEVIATION = ", deviation"
_RUNS, _DIVERGED, _SEEDS = "runs", "diverged", "seeds"  # how many are in a row of `groups`
_WORST = "displacement_worst"
_MEASURED = (
    "delta", "displacement_error", _WORST, "displacement_interpolated", "delta_static", "stress_error",
    "speedup_step", "speedup_total", "speedup_shown", "break_even_runs", "handed_over",
)  # fmt: skip
_SHARE = "integration_share"  # N over all particles
_TIMES = ("step_ms_full", "step_ms_reduced", "total_ms_full", "total_ms_reduced", "shown_ms")
_AVERAGED = [name for name in (*_MEASURED, *RIVALS, _PAPER, *_TIMES) if name != _WORST]
#: Of these the deviation over seeds stands beside the mean.
_SCATTERED = ("delta", "displacement_error", "stress_error", "speedup_step", "speedup_total", "speedup_shown")
_SPLITS = ({"train"}, {"validation"})
_COLUMN_OF = {
    "scene": "scene",
    "method": "method",
    "field": "field",
    "latent_dim": "r",
    "engine": "engine",
    "sampler.size": "sample",
}
_NUMBERS = {column or key for key, (_, _, column) in AXES.items()}
_TITLES = {key: axis(title, unit.strip("–")) for key, (title, unit, _) in AXES.items()}


@dataclass(frozen=True)
class Report:
    """A report's folder, and what its sources.json tells; a key that an older one lacks counts as empty."""

    folder: Path
    told: Mapping

    @cached_property
    def rows(self) -> pd.DataFrame:
        """Held-out rows of results.csv, the keys of their jobs, and the paper's δ (a fraction, or NaN).

        Raises:
            SchemaError: results.csv is missing, or its rows are not those of sources.json.
        """
        path = self.folder / "results.csv"
        frame = pd.read_csv(path, dtype=dict.fromkeys((*TEXT, "r"), str)) if path.is_file() else ()
        if len(frame) != len(self.told["rows"]):
            raise SchemaError(
                f"{path} has not the {len(self.told['rows'])} rows that sources.json tells of; "
                "build the report again with `nsf report`"
            )
        frame = frame.assign(**{name: np.nan for name in LATER if name not in frame})
        shown = frame["total_ms_reduced"] + frame["decode_ms"]
        # Nothing moves has a displacement error of 1.
        still = frame["delta"] / frame["displacement_error"]
        share = frame["integration_mean"] / (frame["gamma"] * frame["r"].astype(float) / 3)  # γ = 3 P / r
        frame = frame.assign(delta_static=still, shown_ms=shown, integration_share=share)
        runs = [self.told["runs"][row["run"]] for row in self.told["rows"]]
        keys = pd.DataFrame([_own(run) for run in runs], index=frame.index).replace("null", np.nan)
        frame = frame.join(keys)
        if TRAIN in frame:
            frame[TRAIN] = counted(frame[TRAIN], frame["scene"])
        records = frame.to_dict("records")
        # A sample's size may follow from its seed.
        alike = ["scene", "method", "field", *(set(SEEDS) & set(frame))]
        numbers = frame.groupby(alike, dropna=False)["sample"].transform("nunique")
        told = zip(records, runs, numbers > 1, strict=True)
        frame[_PAPER] = [self._printed(row, run, compared) for row, run, compared in told]
        particles = (frame["gamma"] * frame["r"].astype(float) / 3).round()
        several = particles.groupby(frame["scene"]).transform("nunique") > 1
        sized = frame["scene"] + " · " + particles.map("{:,.0f} particles".format)
        frame["scene"] = frame["scene"].where(~several, sized)
        held_out = frame["split"] != "train"
        return frame[held_out] if held_out.any() else frame

    @cached_property
    def settings(self) -> list[str]:
        """Columns of `rows` that tell apart what is compared within a scene, as few as can."""
        keys = list(dict.fromkeys(key for run in self.told["runs"].values() for key in _own(run)))
        jobs = [key for key in keys if key not in SEEDS] if keys else ["setting"]
        alone = not self.seeds and self.rows["scene"].nunique() == 1
        known = [
            "method",
            "field",
            "engine",
            *jobs,
            "r",
            "sample",
            *(["parameter"] if _VALUES in keys and alone else []),
        ]
        # A sample's size may follow from its seed.
        beside = ("scene", *self.seeds)
        return telling(self.rows.to_dict("records"), (key for key in known if key in self.rows), beside)

    @cached_property
    def seeds(self) -> list[str]:
        """Keys of seeds that take several values."""
        return [seed for seed in SEEDS if seed in self.rows and self.rows[seed].nunique() > 1]

    @cached_property
    def groups(self) -> pd.DataFrame:
        """A row a scene and setting, with means over held-out values and seeds, and how many these are.

        One that is missing leaves the mean empty; a run that diverged makes it ∞.
        """
        alike = ["scene", *self.settings]
        others = [name for name in _COLUMN_OF.values() if name not in alike]
        rows = []
        # As objects: pandas fills no column of numbers with text.
        filled = self.rows.astype(dict.fromkeys(alike, object)).fillna(dict.fromkeys(alike, ABSENT))
        for values, part in filled.groupby(alike, sort=False):
            row = dict(zip(alike, values, strict=True))
            row |= {name: part[name].iloc[0] if part[name].nunique() == 1 else ABSENT for name in others}
            row |= _means(part) | {_WORST: part["displacement_error"].max()}
            row |= {f"{name}{_DEVIATION}": value for name, value in self._deviations(part).items()}
            row |= {_RUNS: len(part), _DIVERGED: int(np.isinf(part["delta"]).sum())}
            rows.append(row | {_SEEDS: len(part[self.seeds].drop_duplicates()) if self.seeds else 1})
        frame = pd.DataFrame(rows)
        ranks = [frame[key].map(_ranks(frame[key])) for key in alike]
        return frame.iloc[np.lexsort(ranks[::-1])].reset_index(drop=True)

    def _deviations(self, part: pd.DataFrame) -> dict[str, float]:
        """Standard deviation over seeds of the mean over held-out values; none without several seeds."""
        if not self.seeds:
            return {}
        means = pd.DataFrame([_means(of_one) for _, of_one in part.groupby(self.seeds, dropna=False)])
        return {name: means[name].std(skipna=False) for name in _SCATTERED}

    @property
    def small(self) -> set[str]:
        """Scales of its runs that are not the paper's."""
        return {str(run["scale"]) for run in self.told["runs"].values() if run.get("scale")} - {"paper"}

    def _printed(self, row: Mapping, run: Mapping, compared: bool) -> float:
        """The paper's δ of a row: the entry of it, else the scene's where r is its; or NaN.

        Where several |S| of a method are compared, the scene's stands beside its own.
        """
        entries = self.told.get("printed")
        if entries is None:
            stated = (run.get("paper") or {}).get(row["method"], {})
            own = ("r", "sample") if compared else ("r",)
            same = all(str(stated[name]) == row[name] for name in own if name in stated)
            return stated.get("delta", np.nan) if same else np.nan
        known = (run.get("keys") or {}) | {name: row[name] for name in ("scene", "method", "field")}
        known |= {"parameter": parameter_text(row["parameter"])}
        return printed_delta(entries, known)


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
        share = ", and N in % of all particles" if _SHARE in _bracketed(report) else ""
        said = f"Shown: δ [%], in brackets the stress error [%]{share}; {_averaged(report)}.{_best(report)}"
    return table, f"{said}{_beside_paper(report)}{_rivals(report)}{_diverged(report)}"


def _flat(report: Report) -> Rows:
    """A row a scene and setting, with every measure."""
    groups = report.groups
    order = dict.fromkeys(("scene", "method", "field", "engine", *report.settings, "r", "sample"))
    shown = [key for key in order if key == "scene" or groups[key].nunique() > 1]
    hidden = {_WORST} if (groups[_RUNS] == 1).all() else set()
    hidden |= set() if groups["handed_over"].any() else {"handed_over"}
    measured = [name for name in _MEASURED if name not in hidden and groups[name].notna().any()]
    seeds = [_SEEDS] if groups[_SEEDS].nunique() > 1 else []
    paper = ["paper's δ [%]"] if groups[_PAPER].notna().any() else []
    body = [
        [_text(key, row[key]) for key in shown]
        + [f"{row[name]}" for name in seeds]
        + [number(row[_PAPER], 100) for _ in paper]
        + [
            plus_minus(row[name], row.get(f"{name}{_DEVIATION}", np.nan), COLUMN[name].scale)
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
    printed = {at for (_, at), row in found.items() if not np.isnan(row[_PAPER])}
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
                body[-1].append(number(row[_PAPER], 100) if row else "")
    numeric = [*map(_is_number, down), *(True for _ in headings[len(down) :])]
    return Rows(headings, body, numeric)


def _bracketed(report: Report) -> list[str]:
    """What stands beside δ: the stress error and, where samples are compared, the share of N."""
    sampled = any(key == "sample" or key.startswith("sampler") for key in report.settings)
    return ["stress_error", *([_SHARE] if sampled else [])]


def _with_brackets(row: Mapping, bracketed: Sequence[str]) -> str:
    """δ and other means of a row of `groups`, or how many of its runs diverged."""
    if row[_DIVERGED]:
        return f"{row[_DIVERGED]} of {row[_RUNS]} diverged"
    delta = plus_minus(row["delta"], row.get(f"delta{_DEVIATION}", np.nan), 100)
    return f"{delta} ({', '.join(number(row[name], 100) for name in bracketed)})"


def _over_seeds(report: Report) -> Rows:
    """δ of the seeds of each scene, a row for training and one for the sample."""
    body = []
    for seed in report.seeds:
        for scene, part in report.rows[report.rows[seed].notna()].groupby("scene", sort=False):
            delta = part.groupby(seed)["delta"].agg(lambda values: values.mean(skipna=False))
            mean = plus_minus(delta.mean(skipna=False), delta.std(skipna=False), 100)
            told = (delta.min(skipna=False), delta.max(skipna=False), part[_PAPER].mean(skipna=False))
            body.append([scene, seed, f"{len(delta)}", mean, *(number(value, 100) for value in told)])
    headings = ["scene", "varied", "seeds", "mean δ [%]", "smallest [%]", "largest [%]", "paper's δ [%]"]
    if report.rows[_PAPER].isna().all():
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
    known = report.groups.dropna(subset=_PAPER)
    if not len(known):
        return ""
    if report.small:
        return f" The paper's δ is of its full size, these runs are of {min(report.small)} scale."
    known, told = known[known["method"] != _BASELINE], []
    if not len(known):
        return ""
    for (method, field), part in known.groupby(["method", "field"], sort=False):
        below = int((part["delta"] < part[_PAPER]).sum())
        told.append(f"{below} of {len(part)} ({method}, {field})")
    still = (known["delta_static"] < known[_PAPER]).groupby(known["scene"], sort=False).all()
    scenes = ", ".join(still.index[still])
    also = f" A body that never moves has a smaller δ than the paper's on {scenes}." if scenes else ""
    return f" δ is below the paper's in {', '.join(told)} of the rows for which the paper prints one.{also}"


def _defaults(report: Report) -> str:
    """Under which configuration keys cells are empty, since a job does not set them or sets null."""
    keys = {key for run in report.told["runs"].values() for key in _own(run)}
    bare = [_title(key) for key in report.settings if key in keys and (report.groups[key] == ABSENT).any()]
    return f" Where a job does not set {', '.join(bare)}, or sets null, a cell has –." if bare else ""


def _rivals(report: Report) -> str:
    told = where_rivals_win(report.groups)
    return f" {told}" if told else ""


def _diverged(report: Report) -> str:
    count = int(np.isinf(report.rows["delta"]).sum())
    return f" ∞: {count} of the {len(report.rows)} reduced runs diverged." if count else ""


def _means(part: pd.DataFrame) -> dict[str, float]:
    """Means over some rows and speedups of mean times; a value that is missing leaves its mean empty.

    δ of a still body and the share of N are means over the rows that have them.
    """
    means = part.reindex(columns=_AVERAGED).mean(skipna=False).to_dict()
    known = {name: part[name].mean() for name in ("delta_static", _SHARE)}
    return means | known | speedups(means)


def _own(run: Mapping) -> dict[str, str]:
    """Keys of a run's job that no column of results.csv tells."""
    told = {*_COLUMN_OF, "precision", "device"}  # the last two under their own names
    return {key: value for key, value in (run.get("keys") or {}).items() if key not in told}


def _kinds(rows: pd.DataFrame, columns: Sequence[str]) -> int:
    return len(rows.drop_duplicates(list(columns))) if columns else 0


def _sorted(groups: pd.DataFrame, keys: Sequence[str]) -> list[tuple]:
    """The combinations of values that are there, by the keys in turn."""
    ranks = [_ranks(groups[key]) for key in keys]
    known = dict.fromkeys(groups[list(keys)].itertuples(index=False, name=None))
    return sorted(known, key=lambda values: [rank[v] for rank, v in zip(ranks, values, strict=True)])


def _ranks(values: pd.Series) -> dict:
    """What is not set, then numbers by size, then text as it comes."""
    known = list(dict.fromkeys(values))

    def key(value) -> tuple[int, float]:
        if value == ABSENT:
            return (0, 0.0)
        try:
            return (1, float(value))
        except ValueError:
            return (2, float(known.index(value)))

    return {value: rank for rank, value in enumerate(sorted(known, key=key))}


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
