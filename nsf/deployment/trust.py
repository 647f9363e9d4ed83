"""Whether to believe a reduced run: a bound of its error, and what it left that its model was taught.

A run tells of itself how far, in metres, members of a model are from their mean; or, of a single model, how
far its latent vectors are from those of training and what its projections left. Validation runs say how large
errors are at such signals (`nsf.deployment.bound`). Not in the paper.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from weakref import WeakKeyDictionary

import numpy as np
import torch
from scipy.spatial import cKDTree

from nsf import schemas
from nsf.deployment.bound import RED, Calibration, flag_of, rms
from nsf.deployment.reach import Reach
from nsf.dynamics import ReducedMPM
from nsf.errors import SchemaError
from nsf.recurrence.solids import collider_states
from nsf.storage import write_json
from nsf.vectors import lengths, spaced

#: File of a deploy run with what bounds the errors of its model.
TRUST = "trust.json"
#: Training states that tell of displacements, or of distances.
_ROWS, _NEAREST = 256, 4096
#: Growth of a bound a side of the box of parameters away from the nearest validation case.
_AWAY = 0.5


_BAND = {"low": [float], "high": [float], "leeway": float}
_USUAL = {"rows": [[float]], "leeway": float, "every": schemas.Number(1, whole=True)}
_REACH = {
    "names": [str], "box": [[float]], "gravity": [float], "radius": float, "solids": (_BAND, None),
    "states": _BAND, schemas.Maybe("usual"): (_USUAL, None), "changed": str,
}  # fmt: skip
_CALIBRATION = {
    "t": [float], "curve": [float], "slope": float, "factor": (float, None), "typical": (float, None),
    "displacement": float, "errors": [float], "lost": int,
}  # fmt: skip
_FILE = {
    "limit": float, "metric": [[float]], "reach": _REACH, "calibration": (_CALIBRATION, None),
    "validated": [[float]],
}  # fmt: skip


@dataclass(frozen=True)
class Verdict:
    """The error of a run, as far as it can be told without the full-order one.

    Attributes:
        error: [N + 1] expected RMS distance over particles [m]; bound: it is no larger in `LEVEL` of runs.
            NaN where no validation run tells.
        displacement: RMS over the run [m], of which errors are shares.
        limit: share of the displacement above which a run is not believed.
        reason: why it is not to be believed, or nothing is told; empty where the bound alone tells.
        beyond: whether it left what was taught.
    """

    error: np.ndarray
    bound: np.ndarray
    displacement: float
    limit: float
    reason: str = ""
    beyond: bool = False

    @property
    def error_share(self) -> float:
        """Expected error of the whole run, a share of its displacement."""
        return _share(self.error, self.displacement)

    @property
    def bound_share(self) -> float:
        """Its bound, likewise."""
        return _share(self.bound, self.displacement)

    @property
    def flag(self) -> str:
        """Green, amber, red or unknown."""
        return RED if self.beyond else flag_of(self.bound_share, self.limit)

    @property
    def text(self) -> str:
        """The light in words: `amber: expected error 7.1 %, at most 14 % of the displacement`."""
        errors = ""
        if not np.isnan(self.bound_share):
            expected, bound = percent(self.error_share), percent(self.bound_share)
            errors = f"expected error {expected}, at most {bound} of the displacement"
        return f"{self.flag}: " + "; ".join(part for part in (errors, self.reason) if part)


def percent(share: float) -> str:
    """A share as `7.1 %`."""
    return "∞" if np.isinf(share) else "–" if np.isnan(share) else f"{100.0 * share:.3g} %"


def bound_text(bound: float, limit: float) -> str:
    """Why a run is red, of its bound and the limit."""
    why = f"its error bound is {percent(bound)} of the displacement, above {percent(limit)}"
    return why if np.isfinite(bound) else "it left what was taught, or is lost"


def _share(values: np.ndarray, displacement: float) -> float:
    whole = float(rms(values))
    with np.errstate(divide="ignore"):
        return whole if whole == 0.0 or np.isnan(whole) else float(np.divide(whole, displacement))


def metric_of(manifold) -> np.ndarray:
    """[r, r] L: |Δx̂ L| is about the RMS over particles of how far Δx̂ moves them [m].

    From a linear fit of positions at training states, so that no distance needs a field.
    """
    (particles, at), latents = manifold.at_some(), manifold.training_latents
    rows = latents[torch.as_tensor(spaced(len(latents), _ROWS), device=latents.device)]
    with torch.no_grad():
        x = at.position(rows.to(at.device, at.dtype)).double().cpu().numpy().reshape(len(rows), -1)
    xhat = rows.double().cpu().numpy()
    moves = np.linalg.lstsq(xhat - xhat.mean(0), x - x.mean(0), rcond=None)[0]
    values, axes = np.linalg.eigh(moves @ moves.T / len(particles))
    return axes * np.sqrt(np.maximum(values, 0.0))


class Trust:
    """Bounds the errors of the runs of one model.

    Args:
        metric: [r, r] of latent vectors (`metric_of`).
        taught: [K, r] latent vectors of training.
        reach: what was taught; None where it is not known: such a one cannot be written.
        calibration: of validation runs; None where there are none.
        validated: [n, p] parameters of their cases.
        limit: share of the displacement above which a run is not believed.

    Attributes:
        unknown: why nothing is told, where nothing is.
    """

    unknown = "no validation run tells (set scene.design.validation)"

    def __init__(
        self,
        metric: np.ndarray,
        taught: np.ndarray,
        limit: float,
        reach: Reach | None = None,
        calibration: Calibration | None = None,
        validated: np.ndarray | None = None,
    ):
        self.metric, self.limit, self.reach, self.calibration = metric, limit, reach, calibration
        self.validated = np.zeros((0, 0)) if validated is None else validated
        self._taught = taught
        self._forced = WeakKeyDictionary()  # of runs, by version of their forcing: see `outside`

    @classmethod
    def of(cls, manifold, limit: float, *further) -> "Trust":
        """Of a trained manifold."""
        return cls(metric_of(manifold), manifold.training_latents.double().cpu().numpy(), limit, *further)

    @classmethod
    def open(cls, path: Path, manifold) -> "Trust":
        """Of the file that a deploy run has of it.

        Raises:
            SchemaError: the file is none.
        """
        r, taught = manifold.latent_dim, manifold.training_latents.double().cpu().numpy()
        try:
            content = schemas.read(path, _FILE)
            reach, calibration = Reach.read(content["reach"]), content["calibration"]
            calibration = None if calibration is None else Calibration.read(calibration)
            metric, validated = (np.asarray(content[name], float) for name in ("metric", "validated"))
            if metric.shape != (r, r) or reach.states.low.shape != (r,):
                raise ValueError(f"it is not of {r} latent coordinates")
            return cls(metric, taught, content["limit"], reach, calibration, validated)
        except (SchemaError, ValueError) as error:
            raise SchemaError(f"{path} is no calibration of errors ({error}); deploy again") from error

    def save(self, path: Path) -> None:
        """Write it, but for the training states."""
        write_json(path, self.plain)

    @property
    def plain(self) -> dict:
        """Plain containers, as a file and a page have it."""
        return {
            "limit": self.limit,
            "metric": self.metric.tolist(),
            "reach": self.reach.plain(),
            "calibration": None if self.calibration is None else self.calibration.plain(),
            "validated": self.validated.tolist(),
        }

    @cached_property
    def _nearest(self) -> cKDTree:
        rows = self._taught @ self.metric
        return cKDTree(rows[spaced(len(rows), _NEAREST)])

    def moved(self, xhat: np.ndarray) -> np.ndarray:
        """[..., N + 1] RMS displacement [m] of latent vectors [..., N + 1, r] from the first."""
        return lengths((xhat - xhat[..., :1, :]) @ self.metric)

    def signal(
        self, xhat: np.ndarray, members: np.ndarray | None = None, residuals: np.ndarray | None = None
    ) -> np.ndarray:
        """How far off a run says of itself to be [N + 1] [m]; ∞ where it is lost.

        Args:
            xhat: [N + 1, r] latent vectors.
            members: [M, N + 1, r] of each member of a model, M > 1; None of a single one.
            residuals: [N + 1] that projections left at S [m].
        """
        if members is not None:
            off = (members - members.mean(0)) @ self.metric
            return _finite(np.sqrt(np.einsum("mnr,mnr->n", off, off) / (len(members) - 1)))
        good = np.isfinite(xhat).all(-1)
        off = np.full(len(xhat), np.inf)
        off[good] = self._nearest.query(xhat[good] @ self.metric)[0]
        if residuals is not None:
            off = np.hypot(off, residuals)
        return _finite(off)

    def signal_of(self, run: ReducedMPM, first: int = 0) -> np.ndarray:
        """`signal` of a run from a step up to now; linear between strides of members."""
        members, steps = run.members, np.arange(first, run.steps_taken + 1)
        if members is not None:
            at_strides = self.signal(members[0], members)
            return np.interp(steps, run.span.stride * np.arange(len(at_strides)), at_strides)
        residuals = None
        if not run.span.latent_only:
            residuals = np.concatenate([[0.0], run.trajectory().residuals[:, -1]])[first:]
        return self.signal(run.latents[first:], None, residuals)

    def outside(self, run: ReducedMPM, first: int = 1) -> str:
        """Why the inputs of a run, in its steps from one on, are outside of what was taught; empty if not."""
        if self.reach is None:
            return ""
        version, acting, reasons = self._forced.get(run.together, (None, {}, {}))
        if version != run.together.batch.forcing.version:  # until a hand acts
            version, acting, reasons = run.together.batch.forcing.version, {}, {}
            self._forced[run.together] = version, acting, reasons
        if run.index not in acting:
            acting[run.index] = self._acting(run)
        part = run.index, first, run.steps_taken
        if part not in reasons:
            inputs = (values[first - 1 : run.steps_taken] for values in acting[run.index])
            reasons[part] = self.reach.of_inputs(run.setup.values, *inputs, run.dt)
        return reasons[part]

    @staticmethod
    def _acting(run: ReducedMPM) -> tuple[np.ndarray, np.ndarray]:
        """Gravity [N, 3] [m/s²] and states of the colliders [N, f] at every step."""
        forcing, steps = run.together.batch.forcing, run.total_steps
        solids = collider_states(forcing.colliders_of(run.index), run.dt, steps)
        return run.acting_gravity(run.dt * np.arange(steps)), solids

    def of_run(self, run: ReducedMPM, signal: np.ndarray, diverged: int = -1) -> Verdict:
        """The verdict on a run, at its end or in its midst.

        Args:
            run: with the forcing that acts on it.
            signal: [N + 1] of it, from `signal_of`.
            diverged: step at which it diverged; −1: at none.
        """
        t, whole = run.dt * np.arange(run.steps_taken + 1), run.steps_taken == run.total_steps
        return self.judge(run.setup.values, t, run.latents, signal, self.outside(run), diverged, whole)

    def judge(
        self,
        values: Mapping[str, float],
        t: np.ndarray,
        xhat: np.ndarray,
        signal: np.ndarray,
        outside: str = "",
        diverged: int = -1,
        whole: bool = True,
    ) -> Verdict:
        """The verdict on a run of a case.

        Args:
            values: its parameters, by name.
            t: [N + 1] [s]; xhat: [N + 1, r] latent vectors; signal: [N + 1] [m].
            outside: why its inputs are outside of what was taught; empty where they are not.
            diverged: step at which it diverged; −1: at none.
            whole: whether it is at its end; else errors are shares of what validation runs move at least.
        """
        finite = np.isfinite(xhat).all(-1)
        finite[diverged if diverged >= 0 else len(t) :] = False
        lost = not finite.all()
        rows = (np.where(finite[:, None], xhat, xhat[:1]) if lost else xhat) @ self.metric
        displacement = float(rms(lengths(rows - rows[0])))
        beyond, why = bool(outside), outside
        if self.reach is not None and not beyond:
            left = self.reach.of_states(rows[finite] if lost else rows)
            if beyond := bool(left.any()):
                why = f"its shape left those of the training runs at t = {t[finite][left.argmax()]:.3g} s"
        if diverged >= 0:
            why = why or f"it diverged at t = {t[diverged]:.3g} s"
        if self.calibration is None:
            bound = np.full(len(t), np.inf if diverged >= 0 else np.nan)
            share, why = 1.0, why or self.unknown
        else:
            displacement = displacement if whole else max(displacement, self.calibration.displacement)
            bound = self._away(values) * self.calibration.bound(t, signal, displacement)
            if lost:
                bound[~finite] = np.inf
            share = self.calibration.share
            if not why and not len(self.calibration.errors):
                why = "every validation run was lost"
            elif not why and self.calibration.coarse:
                why = "the bound is coarse, of one validation run"
        error = np.where(np.isinf(bound), np.inf, bound * share)
        return Verdict(error, bound, displacement, self.limit, why, beyond)

    def _away(self, values: Mapping[str, float]) -> float:
        """Factor on a bound: 1 in a validation case, more the further away a case is."""
        if self.reach is None or not self.validated.size:
            return 1.0
        sides = np.abs(self.validated - [values[name] for name in self.reach.names]) / self._sides
        return 1.0 + _AWAY * float(sides.max(1, initial=0.0).min())

    @cached_property
    def _sides(self) -> np.ndarray:
        """[p] sides of the box of parameters; ∞ where one does not vary, where none is away."""
        low, high = self.reach.box.T
        return np.where(high > low, high - low, np.inf)

    def calibrated(
        self, reach: Reach, cases: Sequence[Mapping[str, float]], calibration: Calibration
    ) -> "Trust":
        """The same with what validation runs of some cases say."""
        validated = np.array([[case[name] for name in reach.names] for case in cases]).reshape(len(cases), -1)
        return Trust(self.metric, self._taught, self.limit, reach, calibration, validated)


def _finite(values: np.ndarray) -> np.ndarray:
    return np.where(np.isfinite(values), values, np.inf)
