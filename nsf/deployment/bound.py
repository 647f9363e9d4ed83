"""A bound of a run's error with a promise, from runs of validation cases: plain functions of arrays.

A run is never better than validation runs were, and worse where a signal of its own, in metres, is larger
than there. The bound is the least multiple of that which held at validation (conformal prediction):

    bound(t) = factor · max(curve(t) · D, slope · signal(t)),   D: RMS displacement of the run

It holds for `LEVEL` of runs that are drawn as the validation cases are. Not in the paper.

Source: Lei et al. 2018, Distribution-free predictive inference for regression (split conformal prediction).
"""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import cache

import numpy as np
from scipy.special import ndtr

#: Share of runs in which a bound holds.
LEVEL = 0.9
#: Quantile of validation errors below which no bound is, where programs force a scene, or do not. Runs of
#: few parameters err alike, so a new one inherits the largest; programs differ, and signals tell how much.
FLOOR = {True: 0.5, False: 1.0}
#: Standard deviation of the logarithm of errors of runs of one model: between 0.3 and 0.6 in the committed
#: reports. Where validation runs are too few for a quantile it says how much wider a bound has to be.
SCATTER = 0.5
#: Validation runs, at least, whose quantile needs no assumption on how errors scatter.
ENOUGH = math.ceil(LEVEL / (1.0 - LEVEL) - 1e-9)
_FACTORS = ("factor", "typical")
GREEN, AMBER, RED, UNKNOWN = FLAGS = ("green", "amber", "red", "unknown")


@cache
def widening(runs: int) -> float:
    """Factor on the largest of a number of scores that a further one exceeds in 1 − `LEVEL` of all cases.

    For scores that are log-normal with the deviation `SCATTER`; 1 of `ENOUGH` scores and more, where the
    ranks alone promise it.
    """
    if runs >= ENOUGH:
        return 1.0
    z = np.linspace(-8.0, 8.0, 2001)
    largest = runs * np.exp(-0.5 * z**2) / math.sqrt(2.0 * math.pi) * ndtr(z) ** (runs - 1)
    low, high = -8.0, 8.0
    while high - low > 1e-12:
        middle = 0.5 * (low + high)
        below = np.trapezoid(ndtr(z + middle) * largest, z) < LEVEL
        low, high = (middle, high) if below else (low, middle)
    return math.exp(SCATTER * low)


def factor_of(scores: Sequence[float]) -> float:
    """The factor on scores [n] that bounds a new one in `LEVEL` of all cases; ∞ of none."""
    if not len(scores):
        return math.inf
    n = len(scores)
    rank = min(n, math.ceil((n + 1) * LEVEL - 1e-9))
    return float(np.sort(scores)[rank - 1]) * widening(n)


def rms(values: np.ndarray) -> np.ndarray:
    """Root mean square over even steps of [..., N + 1], by the trapezoidal rule; of one, its value."""
    N = values.shape[-1] - 1
    if not N:
        return np.abs(values[..., 0])
    squares = np.square(values)
    return np.sqrt((squares[..., 1:-1].sum(-1) + 0.5 * (squares[..., 0] + squares[..., -1])) / N)


def flag_of(bound: float, limit: float) -> str:
    """The light of a bound: green up to half the limit, amber up to it, red above; unknown of NaN."""
    if math.isnan(bound):
        return UNKNOWN
    return GREEN if bound <= 0.5 * limit else AMBER if bound <= limit else RED


@dataclass(frozen=True)
class Calibration:
    """Errors of validation runs, from which that of a new one is bounded.

    Attributes:
        t: [F] times [s]; curve: [F] their mean shape over time, as large as `floor` of
            them, as a share of a run's displacement.
        slope: median of error over signal [-].
        factor: on the larger of both, for a bound; typical: likewise, for the error in the middle.
        displacement: RMS over runs [m]; errors: [n] of each run, shares of its displacement.
        lost: validation runs that were lost, as they said themselves; they count for nothing.
    """

    t: np.ndarray
    curve: np.ndarray
    slope: float
    factor: float
    typical: float
    displacement: float
    errors: np.ndarray
    lost: int = 0

    @classmethod
    def of(
        cls,
        t: np.ndarray,
        errors: np.ndarray,
        moved: np.ndarray,
        signals: np.ndarray,
        own: np.ndarray,
        floor: float = 1.0,
    ) -> "Calibration":
        """From n runs at F times, each array [n, F] in m.

        Args:
            t: [F] [s].
            errors: RMS distance from the full-order run over particles; ∞ of a run that was lost.
            moved: RMS displacement of the full-order run.
            signals: what each run says of itself; own: its RMS displacement.
            floor: quantile of errors below which no bound is.
        """
        good = np.isfinite(errors).all(1) & np.isfinite(signals).all(1) & np.isfinite(own).all(1)
        errors, moved, signals, own = (values[good] for values in (errors, moved, signals, own))
        lost = int((~good).sum())
        if not len(errors):
            return cls(t, np.zeros(len(t)), 0.0, math.inf, math.inf, 0.0, np.zeros(0), lost)
        shares, size = rms(errors) / rms(moved), rms(own)
        shapes = errors / np.where(rms(errors) > 0.0, rms(errors), 1.0)[:, None]
        shape = shapes.mean(0) / (rms(shapes.mean(0)) or 1.0)
        with np.errstate(divide="ignore", invalid="ignore"):
            ratios = shares * size / rms(signals)
        slope = float(np.median(ratios))
        one = cls(
            t, float(np.quantile(shares, floor)) * shape, slope if math.isfinite(slope) else 0.0, 1.0, 1.0,
            float(np.sqrt(np.mean(size**2))), shares, lost,
        )  # fmt: skip
        expected = [rms(one.bound(t, signal, D)) / D for signal, D in zip(signals, size, strict=True)]
        scores = np.divide(shares, expected, out=np.ones(len(shares)), where=np.array(expected) > 0.0)
        return cls(**vars(one) | {"factor": factor_of(scores), "typical": float(np.median(scores))})

    def bound(self, t: np.ndarray, signal: np.ndarray, displacement: float) -> np.ndarray:
        """Bound of the RMS error over particles [N + 1] [m] at times t [N + 1] [s].

        Args:
            t: of the steps.
            signal: [N + 1] of the run [m]; ∞ where it is lost.
            displacement: D [m].
        """
        curve, lost = np.interp(t, self.t, self.curve) * displacement, ~np.isfinite(signal)
        larger = np.maximum(curve, self.slope * np.where(lost, 0.0, signal))
        return (
            np.where(lost, np.inf, self.factor * larger)
            if math.isfinite(self.factor)
            else np.full(len(t), np.inf)
        )

    @property
    def share(self) -> float:
        """Expected error over its bound."""
        return self.typical / self.factor if math.isfinite(self.factor) else math.nan

    @property
    def coarse(self) -> bool:
        """Whether one run alone says how far errors scatter."""
        return len(self.errors) == 1

    def plain(self) -> dict:
        """Plain containers; None of what is not finite."""
        values = {name: np.asarray(value).tolist() for name, value in asdict(self).items()}
        return values | {name: values[name] if math.isfinite(values[name]) else None for name in _FACTORS}

    @classmethod
    def read(cls, content: dict) -> "Calibration":
        """From plain containers.

        Raises:
            ValueError: times and curve do not fit.
        """
        values = {name: np.asarray(content[name], float) for name in ("t", "curve", "errors")}
        if values["t"].shape != values["curve"].shape or (np.diff(values["t"]) <= 0).any():
            raise ValueError("times and curve do not fit")
        factors = {name: math.inf if content[name] is None else content[name] for name in _FACTORS}
        return cls(**content | values | factors)
