"""One variant of a report: its rows, and of its runs what pictures need."""

import re
from dataclasses import dataclass

import numpy as np
import pandas as pd

from nsf.reporting.bodies import shapes
from nsf.reporting.keeping import code, key_of
from nsf.reporting.sources import Motion, same_parameter
from nsf.reporting.study import SEEDS
from nsf.reporting.tables import Merged, natural
from nsf.reporting.text.columns import parameter_text
from nsf.vectors import spaced

ROWS = 6  # parameter values, or settings, in one picture of final shapes
ENDS = 2  # parameter values of strips and animations: the worst and the best


@dataclass
class Variant:
    """One variant's rows, with everything of its runs that pictures need.

    Attributes:
        merged: all rows of the report; members: which are this variant's.
        label: its name beside others.
        body: the scene, with the material beside it where the report has the scene with several.
        rows, sources: of the members, in one order; runs: their ids.
        scene, method, parameter: of all of them; parameter is name and unit.
        summary: of the newest run; breakdown: its time by stage, and timed: whose time that is. `lend_stages`
            may replace these two.
        held_out: the split that is shown; values: its parameter values; delta: mean δ over them, a fraction.
    """

    merged: Merged
    members: list[int]
    label: str
    body: str = ""

    def __post_init__(self):
        self.rows = self.merged.frame.iloc[self.members]
        self.sources = [self.merged.source[i] for i in self.members]
        newest = max(self.sources, key=lambda source: (source.created, source.id))
        self.summary, self.breakdown = newest.summary, newest.cost.get("breakdown", {})
        self.timed = "a step's"  # whose time the breakdown is
        self.parameter = newest.parameter
        self.scene, self.method = self.rows["scene"].iloc[0], self.rows["method"].iloc[0]
        self.body = self.body or self.scene
        splits = set(self.rows["split"])
        self.held_out = next((s for s in ("test", "validation") if s in splits), self.rows["split"].iloc[0])
        shown = self.rows["split"] == self.held_out
        self.values = sorted(self.rows.loc[shown, "parameter"], key=natural)
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
        """Who took held-out runs over from the engine, as a sentence for captions; empty if none."""
        told, unit = [], self.parameter[1]
        for value, source in zip(self.rows["parameter"], self.sources, strict=True):
            at = (source.trust(value) or {}).get("handed_over_at")
            if at is not None and value in self.values:
                told.append(f"at {parameter_text(value, '', unit)} from {at:.3g} s on")
        return f" The full-order solver goes on {', '.join(told)}." if told else self.left()

    def left(self) -> str:
        """That projected steps took every held-out run in place of operators, as a sentence; else empty."""
        shown = self.rows[self.rows["split"] == self.held_out]
        left = (shown["engine"] == "operators") & (shown["handed_over"] == 1.0)
        return " Projected steps took these runs, from the first step on." if left.all() else ""

    @property
    def seeds(self) -> set[str]:
        """What its label says of seeds."""
        return {part for part in re.split(" · |, ", self.label) if part.partition("=")[0] in SEEDS}

    def ranked(self) -> list[tuple]:
        """Held-out values and their δ, the worst first; a run that diverged is the worst."""
        shown = self.rows["split"] == self.held_out
        deltas = self.rows.loc[shown].groupby("parameter")["delta"].mean(numeric_only=True)
        return sorted(deltas.items(), key=lambda item: -np.nan_to_num(item[1], nan=np.inf, posinf=np.inf))

    def cases(self, limit: int, baseline: "Variant | None" = None) -> list[shapes.Case]:
        """At most `limit` held-out values, evenly from the worst to the best, which are always among them."""
        ranked = self.ranked()
        chosen = spaced(len(ranked), limit)
        values = [ranked[i][0] for i in chosen]
        motions = {m.parameter: m for m in self._motions(values)}
        beside = {m.parameter: m for m in baseline._motions(values)} if baseline else {}
        found = []
        for i, value in zip(chosen, values, strict=True):
            if value in motions:
                place = {0: "worst", len(ranked) - 1: "best"}.get(i, "") if len(ranked) > 1 else ""
                if place and self.seeds:  # another seed's may be worse
                    place += f" of {', '.join(sorted(self.seeds)).replace('=', ' ')}"
                motion, other = motions[value], beside.get(value)
                if other is not None and len(other.t) != len(motion.t):
                    other = None  # its run kept other frames
                found.append(shapes.Case(motion, place, ranked[i][1], other))
        return found

    def case_at(self, value, place: str) -> list[shapes.Case]:
        """The case of a held-out value under the name `place`; none where this variant has not got it."""
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
        """What it is deployed on: the scene and material, and what was changed in it after training."""
        return self.body, str(self.summary.get("changes") or "")


def order(v: Variant) -> tuple[bool, float]:
    """Sort key by mean δ, the smallest first; a variant whose runs another solver took over comes last."""
    return bool(v.continued()), v.delta if np.isfinite(v.delta) else np.inf
