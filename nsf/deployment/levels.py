"""Three levels of one run: operators, the projected step, the full-order solver.

Every so many steps a projected step is taken from the operators' own state. What the operators missed of it,
the defect, is added to their changes, from one such step to the next, and they run once more: how far this
run is from the first estimates how far the first is from the projected one. Where the estimate passes a
tolerance, or the run leaves what it was taught or trained on, the projected step goes on; where that one is
not to be believed either, the full-order solver (`nsf.deployment.handover`).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from nsf.deployment.trust import Trust
from nsf.dynamics import ReducedBatch, ReducedMPM

#: Share of the tolerance up to which a run is by operators that passes it later: who goes on starts well.
_WELL = 0.5


@dataclass(frozen=True)
class Levels:
    """How runs by operators are watched, and when the projected step goes on.

    Attributes:
        projected: parameter values → runs of the projected step at t = 0.
        every: steps from one projected step to the next.
        tolerance: [m] largest estimated error; None for any.
        on_distrust: whether the projected step goes on where a run is not to be believed.
    """

    projected: Callable[[Sequence[float]], ReducedBatch]
    every: int
    tolerance: float | None = None
    on_distrust: bool = False

    def watched(
        self, batch: ReducedBatch, parameters: Sequence[float], trust: Trust
    ) -> list[tuple[ReducedMPM, np.ndarray, int]]:
        """Look at runs that operators have taken to their end.

        Args:
            batch: the runs.
            parameters: value of the problem parameter of each.
            trust: the estimate of whether to believe a run.

        Returns:
            Of each run: the solver that holds all of it, its estimated error [N + 1] [m], 0 where the
            projected step has gone on, and the number of steps by operators.
        """
        estimates = estimated_errors(batch, self.projected(parameters), self.every)
        found = []
        for run, value, estimate in zip(batch.runs, parameters, estimates, strict=True):
            own = self._believed(run, estimate, trust)
            if own < run.steps_taken:
                solver = self.projected([value]).runs[0]
                go_on_projected(run, solver, own)
                run, estimate = solver, np.where(np.arange(len(estimate)) <= own, estimate, 0.0)
            found.append((run, estimate, own))
        return found

    def _believed(self, run: ReducedMPM, estimate: np.ndarray, trust: Trust) -> int:
        """How many steps of a run are left to the operators."""
        steps = run.steps_taken
        finite = np.isfinite(estimate)
        beyond = ~finite if self.tolerance is None else ~(estimate <= self.tolerance)
        if beyond.any():
            well = np.inf if self.tolerance is None else _WELL * self.tolerance
            until = int(np.flatnonzero(beyond)[0])
            steps = int(np.flatnonzero(estimate[:until] <= well)[-1])
        if self.on_distrust:
            latent = run.trajectory()
            ratios = trust.ratios(latent.xhat, latent.residuals[:, -1])
            if run.doubt[0] > 1.0:
                return 0
            above = np.flatnonzero(ratios > 1.0)
            if len(above):
                steps = min(steps, max(0, int(above[0]) - 1))
        return steps


def estimated_errors(batch: ReducedBatch, projected: ReducedBatch, every: int) -> np.ndarray:
    """Estimated distance of runs by operators from projected ones.

    The residuals of the projected steps are put into the record of the runs, for `Trust`.

    Args:
        batch: runs that operators have taken from t = 0.
        projected: the same runs by projected steps; left in the midst of one.
        every: steps from one projected step to the next.

    Returns:
        [B, N + 1] RMS over S [m]; not finite where a run is not.
    """
    record, other, steps = batch.batch.record, projected.batch.record, batch.steps_taken
    checked = np.arange(min(every, steps - 1), steps, every)
    defects = torch.zeros(len(batch), len(checked), record.xhat.shape[-1], dtype=torch.float64)
    for i, n in enumerate(checked.tolist()):
        other.now.copy_(record.xhat[:, n])
        other.before.copy_(record.xhat[:, n - 1])
        other.row.fill_(n)
        other.xhat[:, : n + 1] = record.xhat[:, : n + 1]
        projected.resume(n)
        projected.step(1)
        defects[:, i] = (other.now - record.xhat[:, n + 1]).double().cpu()
        record.residuals[:, n] = other.residuals[:, n]
    good = torch.nan_to_num(defects, nan=0.0, posinf=0.0, neginf=0.0).numpy()
    between = np.stack(
        [np.stack([np.interp(np.arange(steps), checked, column) for column in run.T], 1) for run in good]
    )
    with torch.no_grad():
        again = batch.span.pushed(torch.as_tensor(between))
        found = torch.zeros(len(batch), steps + 1, dtype=torch.float64)
        last = 0
        for count, span in batch.steps_by_span():
            for rows in torch.arange(last, last + count + 1).split(256):
                for run in range(len(batch)):
                    one, two = (
                        span.at_sample.position(of[run, rows].to(span.at_sample.dtype))
                        for of in (record.xhat, again)
                    )
                    found[run, rows] = (one - two).square().sum(-1).mean(-1).sqrt().double().cpu()
            last += count
    found[~torch.isfinite(defects).all(-1).all(-1)] = torch.inf
    return found.numpy()


def go_on_projected(run: ReducedMPM, solver: ReducedMPM, step: int) -> None:
    """Take a run to its end by projected steps, from a step of it on; all of it is in the solver's record.

    Args:
        run: by operators.
        solver: of the same run, by projected steps; the only one of its batch.
        step: how many steps of the run are kept.
    """
    own, other = solver.record, run.record
    own.xhat[: step + 1] = other.xhat[: step + 1]
    own.residuals[:step] = other.residuals[:step]
    own.updates[:step] = 0.0
    if step:
        own.now.copy_(other.xhat[step])
        own.before.copy_(other.xhat[step - 1])
        own.row.fill_(step)
    solver.together.resume(step)
    solver.step(run.steps_taken - step)
