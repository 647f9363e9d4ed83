"""Who goes on with a run that is no longer believed: the projected step, the full-order solver, or nobody.

One rule holds for both: a run stays up to the last step before the first whose trust ratio exceeds 1
(`Trust.of_run`), and the next model goes on from there to the end. Where particles of the projected step
carry stress, which is not known in the midst of a run of latent vectors alone, it takes the whole run anew.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from nsf.data import Case, TrajectoryWriter
from nsf.deployment.rollout import LATENT_MODEL, PROJECTED, Rollout
from nsf.deployment.trust import Trust, first_distrusted
from nsf.dynamics import ReducedBatch, ReducedMPM
from nsf.errors import InstabilityError
from nsf.mpm import FP32, FullOrderMPM, Precision
from nsf.mpm.recording import blocks

#: Times less than this share of Δt apart are the same.
_SAME_TIME = 1e-6


class Stepped(NamedTuple):
    """A run at its end.

    Attributes:
        run: the solver that holds all of its steps.
        by: [N] who took each step; None where all are projected by the model itself.
        estimate: [N + 1] estimated error [m]. It stays as it is while the projected step goes on, and is 0
            where that took the whole run. None where nothing is estimated.
    """

    run: ReducedMPM
    by: np.ndarray | None = None
    estimate: np.ndarray | None = None


@dataclass(frozen=True)
class Fallback:
    """How runs are watched, and who goes on with one that is no longer believed.

    Attributes:
        to: `none`, `projected` or `full`.
        projected: cases → runs of the projected step at t = 0; None for runs whose model projects itself.
    """

    to: str = "none"
    projected: Callable[[Sequence[Case]], ReducedBatch] | None = None

    def projected_runs(self, cases: Sequence[Case]) -> ReducedBatch | None:
        """The runs by projected steps that `apply` needs; None where it takes none."""
        return self.projected(cases) if self.to == "projected" else None

    def apply(self, batch: ReducedBatch, projected: ReducedBatch | None, trust: Trust) -> list[Stepped]:
        """Find the spread of members of runs of latent vectors alone; let the projected step go on with runs.

        Args:
            batch: the runs, at their end.
            projected: the same runs, from `projected_runs`; left in the midst of one.
            trust: the estimate of whether to believe a run.
        """
        spread = batch.span_at(0).spread(batch.steps_taken)
        errors = [None] * len(batch) if spread is None else spread.cpu().numpy()
        ended = []
        for run, estimate in zip(batch.runs, errors, strict=True):
            distrusted = first_distrusted(trust.of_run(run)) if self.to == "projected" else -1
            if distrusted < 0:
                by = np.full(run.steps_taken, LATENT_MODEL, np.int8)
                ended.append(Stepped(run, by, estimate))
            else:
                solver = projected.alone(run.index).runs[0]
                ended.append(_projected_from(max(0, distrusted - 1), run, solver, estimate))
        return ended


def _projected_from(step: int, run: ReducedMPM, solver: ReducedMPM, estimate: np.ndarray | None) -> Stepped:
    """Take a run to its end by projected steps.

    Args:
        step: from which on; 0 where particles carry stress.
        run: of latent vectors alone, at its end.
        solver: the same run by projected steps, at t = 0 and alone in its batch. It gets all steps.
        estimate: [N + 1] of the run [m].
    """
    by = np.full(run.steps_taken, PROJECTED, np.int8)
    if solver.setup.sources.carried:
        step = 0
    if step:
        by[:step] = LATENT_MODEL
        target, source = solver.record, run.record
        target.xhat[: step + 1] = source.xhat[: step + 1]
        target.residuals[:step], target.updates[:step] = source.residuals[:step], 0.0
        target.now.copy_(target.xhat[step])
        target.before.copy_(target.xhat[step - 1])
        target.row.fill_(step)
        solver.together.resume(step)
    solver.step(len(by) - step)
    if estimate is not None:
        constant = estimate[step] if step else 0.0  # of a run that is not finite, all is ∞
        estimate = np.where(np.arange(len(estimate)) < step, estimate, constant)
    return Stepped(solver, by, estimate)


def full_order_step(t: np.ndarray, distrusted: int, dt: float) -> int:
    """Last step before the first distrusted one whose time is a whole number of Δt [s]; 0 if there is none.

    Frames and colliders of the full-order solver then stand where they would in a run of its own.
    """
    fractions = t[:distrusted] / dt
    steps = np.flatnonzero(np.abs(fractions - np.round(fractions)) < _SAME_TIME)
    return int(steps[-1]) if len(steps) else 0


def hand_over(solver: ReducedMPM, rollout: Rollout) -> FullOrderMPM:
    """The full-order solver at the time and in the state in which the rollout handed over.

    x, C and τ are the fields' at every particle, as the run takes them, and v is the backward difference
    of x, as in a reduced step. τ determines F_e up to a rotation, which the laws do not see, and history
    variables as far as the law can tell (`FullOrderMPM.resume`). At t = 0 the state is the scene's own.

    Args:
        solver: the reduced solver of the rollout; only its fields are used.
        rollout: a run with `handed_over` ≥ 0.

    Raises:
        InstabilityError: the decoded state is none of the full-order solver's; see `FullOrderMPM.resume`.
    """
    scene, setup, n = solver.scene, solver.setup, rollout.handed_over
    full = scene.full_order(precision=setup.precision.name, device=str(solver.device))
    if n == 0:
        return full
    decoder = solver.decoder()
    before, now = torch.as_tensor(rollout.xhat[n - 1 : n + 1], dtype=setup.dtype, device=setup.torch_device)
    with torch.no_grad():
        x = decoder.position(now)
        v = (x - decoder.position(before)) / solver.dt
        rate = (now - before) / solver.dt
        stress = None if rollout.stress is None else torch.as_tensor(rollout.stress[n : n + 1])
        C, tau = decoder.affine(now[None], rate[None])[0], decoder.stress(now[None], stress)[0]
    state = (a.double().cpu().numpy() for a in (x, v, C, 0.5 * (tau + tau.mT)))
    full.resume(round(rollout.t[n] / full.dt), *state)
    return full


def go_on(solver: ReducedMPM, rollout: Rollout, path: Path, stored: Precision = FP32) -> int:
    """Run the full-order solver from the hand-over to the end of the scene.

    Args:
        solver: the reduced solver of the rollout.
        rollout: a run with `handed_over` ≥ 0.
        path: of the trajectory, whose first frame is the state handed over.
        stored: precision of its frames.

    Returns:
        Number of particles whose decoded stress was beyond the law and was scaled down to what it carries.

    Raises:
        InstabilityError: the full-order solver loses stability; names the hand-over.
    """
    scene = solver.scene
    try:
        full = hand_over(solver, rollout)
        begin, constants = full.steps_taken, full.constants
        writer = TrajectoryWriter(
            path,
            X=constants.X,
            mass=constants.mass,
            volume0=constants.volume0,
            parameters=rollout.case.parameters,
            dt=full.dt,
            dx=scene.dx,
            frames=scene.steps - begin + 1,
            dtype=np.dtype(stored.numpy).name,
        )
        # The last check falls inside, before the file gets its name: only a run that went well leaves one.
        with writer:
            n = begin
            for block in blocks(full, scene.steps - begin, stored):
                for frame in block:
                    writer.append(n * full.dt, **frame)
                    n += 1
                block.done()
        return full.beyond_law
    except InstabilityError as error:
        raise InstabilityError(
            f"the reduced run at {rollout.case.named} was handed over to the full-order solver at "
            f"t = {rollout.t[rollout.handed_over]:.4g} s, which lost stability: {error}; "
            "deploy with fallback=none, or simulate this case"
        ) from error
