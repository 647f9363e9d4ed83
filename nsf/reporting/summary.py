"""A finished report's rows and their means over values and seeds: from results.csv and sources.json alone."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import pandas as pd

from nsf.errors import SchemaError
from nsf.reporting.sources import printed_delta
from nsf.reporting.study import SEEDS, TRAIN
from nsf.reporting.text.columns import (
    ABSENT,
    LATER,
    RIVALS,
    TEXT,
    counted,
    parameter_text,
    speedups,
    telling,
)

PAPER = "paper"
DEVIATION = ", deviation"
RUNS, DIVERGED, SEED_COUNT = "runs", "diverged", "seeds"  # how many are in a row of `groups`
WORST = "displacement_worst"
MEASURED = (
    "delta", "displacement_error", WORST, "displacement_interpolated", "delta_static", "stress_error",
    "speedup_step", "speedup_total", "speedup_shown", "memory_full_mib", "memory_reduced_mib",
    "break_even_runs", "handed_over",
)  # fmt: skip
SHARE = "integration_share"  # N over all particles
VALUES = "scene.design.test"  # jobs of one scene and seed with this key are about single held-out values
_TIMES = ("step_ms_full", "step_ms_reduced", "total_ms_full", "total_ms_reduced", "shown_ms")
_AVERAGED = [name for name in (*MEASURED, *RIVALS, PAPER, *_TIMES) if name != WORST]
#: Of these the deviation over seeds stands beside the mean.
_SCATTERED = ("delta", "displacement_error", "stress_error")
_COLUMN_OF = {
    "scene": "scene",
    "method": "method",
    "field": "field",
    "latent_dim": "r",
    "engine": "engine",
    "sampler.size": "sample",
}


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
        keys = pd.DataFrame([own_keys(run) for run in runs], index=frame.index).replace("null", np.nan)
        frame = frame.join(keys)
        if TRAIN in frame:
            frame[TRAIN] = counted(frame[TRAIN], frame["scene"])
        records = frame.to_dict("records")
        # A sample's size may follow from its seed.
        alike = ["scene", "method", "field", *(set(SEEDS) & set(frame))]
        numbers = frame.groupby(alike, dropna=False)["sample"].transform("nunique")
        told = zip(records, runs, numbers > 1, strict=True)
        frame[PAPER] = [self._printed(row, run, compared) for row, run, compared in told]
        particles = (frame["gamma"] * frame["r"].astype(float) / 3).round()
        several = particles.groupby(frame["scene"]).transform("nunique") > 1
        sized = frame["scene"] + " · " + particles.map("{:,.0f} particles".format)
        frame["scene"] = frame["scene"].where(~several, sized)
        held_out = frame["split"] != "train"
        return frame[held_out] if held_out.any() else frame

    @cached_property
    def settings(self) -> list[str]:
        """Columns of `rows` that tell apart what is compared within a scene, as few as can."""
        keys = list(dict.fromkeys(key for run in self.told["runs"].values() for key in own_keys(run)))
        jobs = [key for key in keys if key not in SEEDS] if keys else ["setting"]
        alone = not self.seeds and self.rows["scene"].nunique() == 1
        known = [
            "method",
            "field",
            "engine",
            *jobs,
            "r",
            "sample",
            *(["parameter"] if VALUES in keys and alone else []),
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
            row |= _means(part) | {WORST: part["displacement_error"].max()}
            row |= {f"{name}{DEVIATION}": value for name, value in self._deviations(part).items()}
            row |= {RUNS: len(part), DIVERGED: int(np.isinf(part["delta"]).sum())}
            rows.append(row | {SEED_COUNT: len(part[self.seeds].drop_duplicates()) if self.seeds else 1})
        frame = pd.DataFrame(rows)
        ranks = [frame[key].map(ranked(frame[key])) for key in alike]
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


def _means(part: pd.DataFrame) -> dict[str, float]:
    """Means over some rows and speedups of mean times; a value that is missing leaves its mean empty.

    The share of N is the mean over the rows that have it.
    """
    means = part.reindex(columns=_AVERAGED).mean(skipna=False).to_dict()
    return means | {SHARE: part[SHARE].mean()} | speedups(means)


def own_keys(run: Mapping) -> dict[str, str]:
    """Keys of a run's job that no column of results.csv tells."""
    told = {*_COLUMN_OF, "precision", "device"}  # the last two under their own names
    return {key: value for key, value in (run.get("keys") or {}).items() if key not in told}


def ranked(values: pd.Series) -> dict:
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
