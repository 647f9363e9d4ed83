"""Ranges of parameters, forcing and states in training and teaching; outside of them no bound holds."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial.distance import cdist

from nsf.recurrence.solids import FEATURES
from nsf.vectors import drawn, lengths

#: Of a value: what float32 may have moved it by.
_ROUND_OFF = 1e-6
#: Times as far as other runs went beyond the ranges that a new one of the kind may go.
_AGAIN = 2.0
#: Of the size of the ranges of latent states: what a run may leave them by, at least and at most.
_LEAST, _MOST = 0.1, 1.0
#: States of runs by which others are judged, at most, and frames of a run that are looked at, about.
_ROWS, _FRAMES = 1024, 64
#: Runs whose quartiles tell of outliers, at least; ranges between quartiles from the upper one to an outlier.
_FEWEST, _FENCE = 8, 1.5


@dataclass(frozen=True)
class Band:
    """Ranges of numbers, and how far beyond these a run may go.

    Attributes:
        low, high: [f]; leeway: distance beyond them, over half of their width, that is allowed.
    """

    low: np.ndarray
    high: np.ndarray
    leeway: float

    @classmethod
    def of_solids(cls, states: np.ndarray, dt: float) -> "Band":
        """Of states [M, N, f] of solids in training runs; another may go twice as far as one of them does."""
        rows = velocities(states, dt)
        low, high, beyond = rows.min(1), rows.max(1), 0.0
        for run in range(len(rows)) if len(rows) > 1 else ():
            without = cls(np.delete(low, run, 0).min(0), np.delete(high, run, 0).max(0), 0.0)
            off = without.each(rows[run])
            beyond = max(beyond, float(off[np.isfinite(off)].max(initial=0.0)))
        return cls(low.min(0), high.max(0), _AGAIN * beyond)

    @classmethod
    def of_states(cls, rows: np.ndarray, others: Sequence[np.ndarray]) -> "Band":
        """Of latent states [K, r] [m] of training runs; others: [N, r] of validation runs."""
        one = cls(rows.min(0), rows.max(0), 0.0)
        farthest = [float(np.max(one.together(states), initial=0.0)) for states in others]
        beyond = max((far for far in farthest if np.isfinite(far)), default=0.0)  # a lost run widens nothing
        return cls(one.low, one.high, float(np.clip(_AGAIN * beyond, _LEAST, _MOST)))

    def each(self, rows: np.ndarray) -> np.ndarray:
        """[..., f] how far each number is beyond its range, over half of the range; 0 inside."""
        beyond, half = self._beyond(rows), 0.5 * (self.high - self.low)
        varies = half > self._slack
        return np.divide(beyond, half, out=np.where(beyond > 0.0, np.inf, 0.0), where=varies)

    def together(self, rows: np.ndarray) -> np.ndarray:
        """[...] how far rows [..., f] of one unit are beyond, over half of the diagonal."""
        half = 0.5 * float(np.linalg.norm(self.high - self.low))
        return lengths(self._beyond(rows)) / (half or 1.0)

    def passed(self, rows: np.ndarray) -> bool:
        """Whether a number of rows [N, f] is further beyond its range than the leeway."""
        return bool(len(rows)) and bool((self.each(np.stack([rows.min(0), rows.max(0)])) > self.leeway).any())

    def _beyond(self, rows: np.ndarray) -> np.ndarray:
        low, high = self._ends
        off = np.maximum(low - rows, rows - high)
        return np.where(np.isnan(off), np.inf, np.maximum(off, 0.0))

    @cached_property
    def _slack(self) -> np.ndarray:
        """[f] what round-off may move the numbers by."""
        return _ROUND_OFF * np.maximum(np.abs(self.low), np.abs(self.high))

    @cached_property
    def _ends(self) -> tuple[np.ndarray, np.ndarray]:
        """[f] and [f] lowest and highest numbers that are not beyond."""
        return self.low - self._slack, self.high + self._slack

    def plain(self) -> dict:
        """Plain containers."""
        return {"low": self.low.tolist(), "high": self.high.tolist(), "leeway": self.leeway}

    @classmethod
    def read(cls, content: Mapping) -> "Band":
        """From plain containers."""
        return cls(
            np.asarray(content["low"], float), np.asarray(content["high"], float), float(content["leeway"])
        )


@dataclass(frozen=True)
class Usual:
    """Latent states of runs that taught a model, and how near to others each of these runs keeps.

    A range says little where a few runs go far: one of twenty falls over, say, and widens it for all. So each
    run is held to the states of all others, and a new one is usual that is no outlier among them.

    Source: Tukey 1977, Exploratory Data Analysis: an outlier is one and a half interquartile ranges above the
    upper quartile.

    Attributes:
        rows: [K, r] [m] states of all runs.
        leeway: distance [m] to the nearest of these beyond which a run is an outlier.
        every: steps from one frame that is looked at to the next.
    """

    rows: np.ndarray
    leeway: float
    every: int = 1

    @classmethod
    def of(cls, runs: np.ndarray, every: int = 1) -> "Usual | None":
        """Of latent states [R, N + 1, r] [m] of runs; None of too few to say what is usual.

        Args:
            runs: every so many steps.
            every: steps from one of their frames to the next.
        """
        if len(runs) < _FEWEST:
            return None
        apart = max(1, runs.shape[1] // _FRAMES)
        frames = runs[:, ::apart]
        chosen = drawn(frames.shape[0] * frames.shape[1], _ROWS)
        rows, owners = frames.reshape(-1, frames.shape[2])[chosen], chosen // frames.shape[1]
        farthest = [_nearest(one, rows[owners != run]).max() for run, one in enumerate(frames)]
        lower, upper = np.quantile(farthest, (0.25, 0.75))
        return cls(rows, float(upper + _FENCE * (upper - lower)), every * apart)

    def left(self, rows: np.ndarray, every: int) -> np.ndarray:
        """[N] whether a run with states [N, r] [m] is further off, at each `every`-th; False at others."""
        far = np.zeros(len(rows), bool)
        far[::every] = _nearest(rows[::every], self.rows) > self.leeway
        return far

    def plain(self) -> dict:
        """Plain containers."""
        rows = [[float(f"{value:.5g}") for value in row] for row in self.rows]  # a page has them
        return {"rows": rows, "leeway": self.leeway, "every": self.every}

    @classmethod
    def read(cls, content: Mapping) -> "Usual":
        """From plain containers."""
        return cls(np.asarray(content["rows"], float), float(content["leeway"]), int(content["every"]))


def _nearest(rows: np.ndarray, others: np.ndarray) -> np.ndarray:
    """[n] distance of each of rows [n, r] to the nearest of others [K, r]."""
    return cdist(rows, others).min(1)


@dataclass(frozen=True)
class Reach:
    """Parameters, forcing and latent states of the runs that a model learned from.

    Attributes:
        names, box: [n, 2] ranges of the problem parameters.
        gravity: [3] middle of all gravity [m/s²]; radius: how far from it any was [m/s²].
        solids: states of the solids that programs move; None where they move none.
        states: latent states in metres (`Trust.metric`).
        usual: which of these are, where programs force the scene; None where it is not known.
        changed: in what the deployed scene differs from that of training; empty where it does not.
    """

    names: tuple[str, ...]
    box: np.ndarray
    gravity: np.ndarray
    radius: float
    solids: Band | None
    states: Band
    usual: Usual | None = None
    changed: str = ""

    def of_inputs(
        self, values: Mapping[str, float], gravity: np.ndarray, solids: np.ndarray, dt: float
    ) -> str:
        """Why the inputs of a run are outside; empty where they are not.

        Args:
            values: of the parameters, by name.
            gravity: [N, 3] in its course [m/s²]; solids: [N, f] states of the colliders, in steps of dt [s].
        """
        if self.changed:
            return f"deploy.changes has {self.changed}, which no training run had"
        for name, (low, high) in zip(self.names, self.box.tolist(), strict=True):
            slack = _ROUND_OFF * max(abs(low), abs(high))
            if not low - slack <= values[name] <= high + slack:
                return f"{name}={values[name]:g} is outside of {low:g} … {high:g}"
        away = float(np.linalg.norm(np.asarray(gravity) - self.gravity, axis=-1).max(initial=0.0))
        if away > self.radius + _ROUND_OFF * (self.radius + float(np.linalg.norm(self.gravity))):
            return f"gravity is {away:.3g} m/s² from that which was taught, {self.radius:.3g} m/s² at most"
        if self.solids is not None and self.solids.passed(velocities(solids, dt)):
            return "a solid is where, or as fast as, no program of training moves it"
        return ""

    def of_states(self, rows: np.ndarray, every: int | None = None) -> np.ndarray:
        """[N] whether latent states of a run are outside, or no usual ones.

        Args:
            rows: [N, r] [m].
            every: of these are looked at for being usual; None: as many as lie between frames of teaching.
        """
        outside = self.states.together(rows) > self.states.leeway
        if self.usual is None or not len(rows):
            return outside
        return outside | self.usual.left(rows, every or self.usual.every)

    def plain(self) -> dict:
        """Plain containers."""
        return {
            "names": list(self.names), "box": self.box.tolist(), "gravity": self.gravity.tolist(),
            "radius": self.radius, "solids": None if self.solids is None else self.solids.plain(),
            "states": self.states.plain(), "changed": self.changed,
            "usual": None if self.usual is None else self.usual.plain(),
        }  # fmt: skip

    @classmethod
    def read(cls, content: Mapping) -> "Reach":
        """From plain containers."""
        solids, usual = content["solids"], content.get("usual")
        return cls(
            tuple(map(str, content["names"])), np.asarray(content["box"], float).reshape(-1, 2),
            np.asarray(content["gravity"], float), float(content["radius"]),
            None if solids is None else Band.read(solids), Band.read(content["states"]),
            None if usual is None else Usual.read(usual), str(content["changed"]),
        )  # fmt: skip


def velocities(states: np.ndarray, dt: float) -> np.ndarray:
    """States [..., f] of solids with velocities in place of changes in a step of dt [s]."""
    rows = states.reshape(*states.shape[:-1], states.shape[-1] // FEATURES, FEATURES).copy()
    rows[..., 4:8] /= dt
    return rows.reshape(states.shape)
