"""Reduced runs from t = 0 to the end of their scene, and what each leaves."""

import io
import math
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np

from nsf.data import Case, hdf5
from nsf.deployment.levels import FULL_ORDER, LEVELS, OPERATORS, PROJECTED, Levels
from nsf.deployment.trust import Trust, first_distrusted
from nsf.dynamics import STOP_REASONS, ReducedBatch, ReducedMPM
from nsf.engines.operators.states import collider_states
from nsf.errors import SchemaError
from nsf.storage import writing
from nsf.timing import synchronizer

_VERSION = 4
_SCALARS = {
    "away": float, "sample": int, "integration_mean": float, "needed_outside": int, "seconds": float,
    "diverged": int, "handed_over": int,
}  # fmt: skip
_ARRAYS = ("t", "xhat", "residuals", "trust")
_REAL = ("<f4", "<f8")  # types of the arrays: that of the run
#: Steps between looks at the trust of a run that is to be handed over: a look reads back, and what was
#: done since the last one is lost.
_LOOK = 20
#: Stands for a stop reason where a step of the latent vector alone ends in no inversion.
_LATENT = "latent"
#: Times less than this share of Δt apart are the same.
_SAME_TIME = 1e-6


@dataclass
class Rollout:
    """One reduced run.

    Attributes:
        case: its problem parameters.
        t: [N + 1] time [s]; xhat: [N + 1, r] latent vectors.
        residuals: [N, k + 1] projection residuals [m]; stops: [N] stop reasons.
        trust: [N + 1] how far each step is from the training data, in units of how far these are from
            themselves (`Trust.ratios`, and `away` where that is above 1).
        away: how far the case is from the training cases, in units of their spacing (`CaseDistance`).
        sample: |S| of the first span of time; integration_mean: mean |N| over all steps taken.
        needed_outside: most particles or nodes a step needed outside the superset.
        seconds: wall time of the steps, without set-up; of a batch, an equal share of it.
        diverged: step at which x̂ ceased to be finite or a sample particle left the grid, −1 when neither did.
        handed_over: step from whose state the full-order solver goes on, −1 when it does not. The steps then
            end with the first distrusted one.
        estimate: [N + 1] how far a run by operators is from one by projected steps alone, as far as is known
            [m]; None where nothing is estimated.
        by: [N] who took each step: 0 a model of latent vectors alone, 1 the projected step, 2 the full-order
            solver, from `handed_over` on; None for a run whose steps are projected.
    """

    case: Case
    t: np.ndarray
    xhat: np.ndarray
    residuals: np.ndarray
    stops: list[str]
    trust: np.ndarray
    away: float
    sample: int
    integration_mean: float
    needed_outside: int
    seconds: float
    diverged: int
    handed_over: int = -1
    estimate: np.ndarray | None = None
    by: np.ndarray | None = None

    @property
    def levels(self) -> np.ndarray:
        """[N] `by` of any run."""
        by = np.full(len(self.stops), PROJECTED) if self.by is None else self.by
        handed = (self.handed_over >= 0) & (np.arange(len(by)) >= self.handed_over)
        return np.where(handed, FULL_ORDER, by).astype(np.int8)

    @property
    def projected_share(self) -> float:
        """Share of steps, in a run of another model, that the projected step took; 0 of any other run."""
        return 0.0 if self.by is None else float((self.levels == PROJECTED).mean())

    @property
    def by_operators(self) -> int:
        """How many steps a model of latent vectors alone took."""
        return int((self.levels == OPERATORS).sum())

    @property
    def estimated_error(self) -> float:
        """Largest of `estimate` [m]; NaN where nothing is estimated, or another model took every step."""
        return math.nan if self.estimate is None or not self.by_operators else float(self.estimate.max())

    @property
    def distrusted(self) -> int:
        """First step that is not to be believed (ratio above 1), −1 when there is none."""
        return first_distrusted(self.trust)

    def save(self, path: Path) -> None:
        """Write as HDF5, whole or not at all."""
        # In memory first: HDF5 cannot report a full disk when it closes a file.
        memory = io.BytesIO()
        with h5py.File(memory, "w") as file:
            file.attrs.update({"nsf_rollout": _VERSION} | {name: getattr(self, name) for name in _SCALARS})
            for name in _ARRAYS:
                file[name] = getattr(self, name)
            if self.by is not None:
                file["by"] = self.levels
            if self.estimate is not None:
                file["estimate"] = self.estimate
            file["stops"] = np.array(self.stops, dtype=h5py.string_dtype())
            file["case"] = self.case.numbers
            for name in ("names", "units"):
                of_all = getattr(self.case, name) or ("",) * len(self.case)
                file[f"case_{name}"] = np.array(of_all, dtype=h5py.string_dtype())
        with writing(path) as partial:
            partial.write_bytes(memory.getbuffer())

    @classmethod
    def open(cls, path: Path, latent_dim: int | None = None) -> "Rollout":
        """Read a rollout.

        Args:
            path: of the file.
            latent_dim: r of the manifold it is of; None for any.

        Raises:
            MissingRunError: there is no such file.
            SchemaError: the file was changed after its run, is truncated, foreign or newer, or says what no
                run does.
        """
        with hdf5.opened(path, "rollout", "deploy") as file, hdf5.reading(path, "rollout", "deploy"):
            version = None
            with suppress(KeyError, SchemaError):
                version = hdf5.attribute(file, "nsf_rollout", int)
            if version != _VERSION:
                raise SchemaError(f"is not a rollout of version {_VERSION} (found {version})")
            scalars = {name: hdf5.attribute(file, name, kind) for name, kind in _SCALARS.items()}
            t = hdf5.values(file, "t", _REAL, (None,), increasing=True)
            shapes = {"xhat": (len(t), latent_dim), "residuals": (len(t) - 1, None), "trust": (len(t),)}
            arrays = {name: hdf5.array(file, name, _REAL, shape)[()] for name, shape in shapes.items()}
            stops = hdf5.texts(file, "stops", (len(t) - 1,))
            numbers = hdf5.values(file, "case", ("<f8",), (None,))
            names, units = (hdf5.texts(file, f"case_{name}", numbers.shape) for name in ("names", "units"))
            if "by" in file:
                arrays["by"] = hdf5.array(file, "by", ("|i1",), (len(t) - 1,))[()]
            if "estimate" in file:
                arrays["estimate"] = hdf5.array(file, "estimate", _REAL, (len(t),))[()]
            found = cls(Case(names, numbers, units), **scalars, t=t, **arrays, stops=stops)
            found._check()
        return found

    def _check(self) -> None:
        """Raises SchemaError where the values are none that a run leaves."""
        steps = len(self.t) - 1
        for name, least, most in (
            ("sample", 1, np.inf),
            ("needed_outside", 0, np.inf),
            ("diverged", -1, steps),
            ("handed_over", -1, steps),
            ("seconds", 0, np.inf),
            ("away", 0, np.inf),
            ("integration_mean", 0, np.inf),
        ):
            if not least <= getattr(self, name) <= most:
                raise SchemaError(f"has {name}={getattr(self, name)}, in {steps} steps")
        # A run that diverged, or was handed over before it did, may end in what is not finite.
        last = (
            self.handed_over if self.handed_over >= 0 else self.diverged - 1 if self.diverged >= 0 else steps
        )
        hdf5.check("xhat", self.xhat[: max(0, last) + 1])
        hdf5.check("residuals", self.residuals[: max(0, last)])
        for name in ("trust", "estimate"):
            values = getattr(self, name)
            if values is not None and not (values >= 0).all():
                raise SchemaError(f"has values of {name} that are negative or no numbers")
        if self.by is not None and not np.isin(self.by, range(len(LEVELS))).all():
            raise SchemaError("has steps by none of " + ", ".join(LEVELS))
        if unknown := set(self.stops) - {*STOP_REASONS, _LATENT}:
            raise SchemaError(f"has stops={sorted(unknown)[0]!r}, which is no reason to stop")


def rollout_file(index: int) -> str:
    """File of a deploy run with the reduced run of the held-out case of that index."""
    return f"rollout_{index}.h5"


def continuation_file(index: int) -> str:
    """File of a deploy run in which the full-order solver goes on with that reduced run."""
    return f"continuation_{index}.h5"


def rollout(solver: ReducedMPM, case: Case, trust: Trust, until_distrusted: bool = False) -> Rollout:
    """Run a reduced solver to the end of its scene.

    Args:
        solver: at t = 0; the only one of its batch.
        case: its problem parameters, for the record.
        trust: the estimate of whether to believe the run.
        until_distrusted: stop at the first step that is not to be believed, and name the one before it from
            whose state a full-order run can go on: the last whose time is a whole number of the scene's Δt.
    """
    return rollouts(solver.together, [case], trust, until_distrusted)[0]


def rollouts(
    batch: ReducedBatch,
    cases: Sequence[Case],
    trust: Trust,
    until_distrusted: bool = False,
    levels: Levels | None = None,
) -> list[Rollout]:
    """Run a batch to the end of its scene.

    Args:
        batch: at t = 0.
        cases: problem parameters of each run, for the record.
        trust, until_distrusted: as for `rollout`; steps are taken for as long as any run is to be believed.
        levels: who goes on with runs by operators, and how these are watched; their time counts too. None
            where no operators step, or nobody looks.
    """
    if levels is None or not levels.near:
        taken = batch if levels is None else levels.projected(cases)
        seconds = _timed_run(taken, trust if until_distrusted else None) / len(batch)
        by = estimate = None
        if levels is not None:
            by, estimate = np.full(taken.total_steps, PROJECTED, np.int8), np.zeros(taken.total_steps + 1)
        watched = [(run, estimate, by) for run in taken.runs]
    else:
        # Built before the clock starts, as `batch` is.
        projected = levels.projected(cases) if levels.projects else None
        seconds, started = _timed_run(batch, None), time.perf_counter()
        watched = levels.watched(batch, projected, trust)
        del projected  # what comes after decodes every particle
        seconds = (seconds + time.perf_counter() - started) / len(batch)
    found = []
    for (run, estimate, by), case, (off, _) in zip(watched, cases, batch.doubts, strict=True):
        own = _rollout_of(run, case, trust, until_distrusted, seconds)
        if by is not None:
            steps = len(own.stops)
            own.by, own.estimate = by[:steps], None if estimate is None else estimate[: steps + 1]
            own.stops = [_LATENT if b == OPERATORS else s for b, s in zip(own.by, own.stops, strict=True)]
            if off > 1.0:
                after = np.append(by[:1], own.by) == OPERATORS  # [steps + 1], of none as well
                own.trust = np.where(after, np.maximum(own.trust, off), own.trust)
        found.append(own)
    return found


def _rollout_of(
    solver: ReducedMPM, case: Case, trust: Trust, until_distrusted: bool, seconds: float
) -> Rollout:
    """What a run that has ended leaves."""
    taken = solver.steps_taken
    latent = solver.trajectory()
    diverged, handed_over, steps = solver.left_grid(), -1, taken
    ratios = _ratios(solver, trust, diverged)
    distrusted = first_distrusted(ratios)
    if until_distrusted and distrusted >= 0:
        diverged, steps = -1, distrusted
        handed_over = _whole_step_before(latent.t, distrusted, solver.scene.dt)
    believed = steps if handed_over < 0 else handed_over
    outside = solver.needed_outside(believed) if diverged < 0 else 0
    return Rollout(
        case=case,
        t=latent.t[: steps + 1],
        xhat=latent.xhat[: steps + 1],
        residuals=latent.residuals[:steps],
        stops=latent.stops[:steps],
        trust=ratios[: steps + 1],
        away=trust.cases.of(case),
        sample=solver.sample_size,
        integration_mean=solver.integration_mean,
        needed_outside=outside,
        seconds=seconds,
        diverged=diverged,
        handed_over=handed_over,
    )


def _timed_run(solver: ReducedBatch, trust: Trust | None) -> float:
    """Take every step, or with an estimate of trust stop soon after it believes none of the runs any more.

    Returns:
        Wall time [s] of the steps; the first, which compiles, loads and captures, counts as the others' mean.
    """
    solver.step(1)
    wait = synchronizer(solver.device)
    wait()
    believed, looked, started = solver.runs, 0, time.perf_counter()
    look = solver.total_steps if trust is None else _LOOK
    while solver.steps_taken < solver.total_steps:
        solver.step(min(look, solver.total_steps - solver.steps_taken))
        if trust is not None:
            believed = [
                run
                for run in believed
                if first_distrusted(_ratios(run, trust, run.left_grid(since=looked + 1))) < 0
            ]
            if not believed:
                break
            looked = solver.steps_taken
    wait()
    taken = solver.steps_taken
    return (time.perf_counter() - started) * taken / max(1, taken - 1)


def _ratios(solver: ReducedMPM, trust: Trust, diverged: int) -> np.ndarray:
    """Trust of the steps taken [n + 1]; ∞ from the step at which the run diverged."""
    latent = solver.trajectory()
    ratios = trust.ratios(latent.xhat, latent.residuals[:, -1])
    # Not below 1: there the steps themselves tell more.
    for off in (solver.doubt[0], trust.cases.of(solver.setup.given)):
        if off > 1.0:
            ratios = np.maximum(ratios, off)
    ratios[1:] = np.maximum(ratios[1:], forcing_ratios(solver, trust))
    if diverged >= 0:
        ratios[diverged:] = np.inf
    return ratios


def forcing_ratios(solver: ReducedMPM, trust: Trust, first: int = 0) -> np.ndarray:
    """`Trust.of_forcing` at each step taken from a first one on; a step takes the gravity of its start."""
    taken, dt = solver.steps_taken, solver.together.dt
    colliders = solver.together.batch.forcing.colliders_of(solver.index)
    solids = collider_states(colliders, dt, taken)[first:]
    return trust.of_forcing(solver.acting_gravity(dt * np.arange(first, taken)), solids, dt)


def _whole_step_before(t: np.ndarray, step: int, dt: float) -> int:
    """Last step before `step` whose time is a whole number of Δt [s]; 0, the start, if there is none.

    Frames and colliders of the full-order solver then stand where they would in a run of its own.
    """
    fractions = t[:step] / dt
    whole = np.flatnonzero(np.abs(fractions - np.round(fractions)) < _SAME_TIME)
    return int(whole[-1]) if len(whole) else 0
