"""Who takes the steps of a run that operators begin, and how far it is from one by projected steps.

Every so many steps a projected step is taken from the operators' own state. What the operators missed of it,
the defect, is added to their changes, from one such step to the next, and they run once more: how far this
run is from the first estimates how far the first is from the projected one. Where a run leaves what it was
taught or trained on, the projected step may go on, to the end. With stress=particles these carry stress
that nobody knows in the midst of a run by operators: there the projected step takes the whole run anew, from
t = 0. Where operators are too far off at validation runs, they take no step.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import groupby

import numpy as np
import torch

from nsf.data import Case
from nsf.deployment.trust import Trust, first_distrusted
from nsf.dynamics import ReducedBatch, ReducedMPM

#: Who takes a step.
OPERATORS, PROJECTED, FULL_ORDER = range(3)
LEVELS = ("operators", "projected", "full_order")
_ROWS = 1024  # latent vectors decoded at once


@dataclass(frozen=True)
class Levels:
    """How runs by operators are watched, and whether the projected step goes on with them.

    Attributes:
        projected: cases → runs of the projected step at t = 0.
        every: steps from one projected step to the next; 0: nothing is estimated.
        goes_on: whether the projected step goes on where a run is not to be believed.
        near: whether operators were near enough at validation runs; else the projected step takes all runs.
    """

    projected: Callable[[Sequence[Case]], ReducedBatch]
    every: int
    goes_on: bool = False
    near: bool = True

    @property
    def projects(self) -> bool:
        """Whether projected steps are taken."""
        return bool(self.every) or self.goes_on

    def watched(
        self, batch: ReducedBatch, projected: ReducedBatch | None, trust: Trust
    ) -> list[tuple[ReducedMPM, np.ndarray | None, np.ndarray]]:
        """Look at runs that operators have taken to their end.

        Args:
            batch: the runs.
            projected: the same runs by projected steps, of `self.projected`; left in the midst of one. None
                where none are taken.
            trust: the estimate of whether to believe a run.

        Returns:
            Of each run: the solver that holds all of it, its estimated error [N + 1] [m], which stays as it
            is while the projected step goes on and is 0 of a run taken anew, None where nothing is estimated,
            and who took each step [N], `OPERATORS` or `PROJECTED`.
        """
        estimates = estimated_errors(batch, projected, self.every) if self.every else [None] * len(batch)
        found = []
        for run, estimate in zip(batch.runs, estimates, strict=True):
            believed = _believed(run, trust) if self.goes_on else run.steps_taken
            if believed == run.steps_taken:
                found.append((run, estimate, np.full(believed, OPERATORS, np.int8)))
            else:
                found.append(_projected_from(believed, run, projected.alone(run.index).runs[0], estimate))
        return found


def _believed(run: ReducedMPM, trust: Trust) -> int:
    """How many of a run's steps are left to the operators: those before the last one that is believed."""
    if max(run.doubt[0], trust.cases.of(run.setup.given)) > 1.0:
        return 0
    residuals = run.record.residuals[: run.steps_taken, -1].cpu().numpy()
    ratios = trust.ratios(run.record.xhat[: run.steps_taken + 1].cpu().numpy(), residuals)
    above = first_distrusted(ratios)
    return run.steps_taken if above < 0 else max(0, above - 1)


def _projected_from(
    step: int, run: ReducedMPM, solver: ReducedMPM, estimate: np.ndarray | None
) -> tuple[ReducedMPM, np.ndarray | None, np.ndarray]:
    """Take a run to its end by projected steps.

    Args:
        step: from which on; 0 where particles carry stress.
        run: by operators, to the end.
        solver: of the same run, by projected steps, at t = 0 and alone in its batch. It gets all steps.
        estimate: [N + 1] of the run [m].

    Returns:
        As `Levels.watched`.
    """
    by = np.full(run.steps_taken, PROJECTED, np.int8)
    if solver.setup.sources.carried:
        step = 0
    if step:
        by[:step] = OPERATORS
        target, source = solver.record, run.record
        target.xhat[: step + 1] = source.xhat[: step + 1]
        target.residuals[:step], target.updates[:step] = source.residuals[:step], 0.0
        target.now.copy_(target.xhat[step])
        target.before.copy_(target.xhat[step - 1])
        target.row.fill_(step)
        solver.together.resume(step)
    solver.step(len(by) - step)
    if estimate is None:
        return solver, None, by
    held = estimate[step] if step else 0.0  # of a run that is not finite, all is ∞
    return solver, np.where(np.arange(len(estimate)) < step, estimate, held), by


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
    steps = batch.steps_taken
    checked = list(range(min(every, steps - 1), steps, every))
    defects = torch.stack([_defect(batch, projected, n) for n in checked], 1)
    return _carried(batch, checked, defects)


def _defect(batch: ReducedBatch, projected: ReducedBatch, n: int) -> torch.Tensor:
    """[B, r] what operators missed of a projected step from their own state after n steps."""
    record, other = batch.batch.record, projected.batch.record
    other.now.copy_(record.xhat[:, n])
    other.before.copy_(record.xhat[:, n - 1])
    other.row.fill_(n)
    other.xhat[:, : n + 1] = record.xhat[:, : n + 1]
    projected.resume(n)
    projected.step(1)
    record.residuals[:, n] = other.residuals[:, n]
    return (other.now - record.xhat[:, n + 1]).double().cpu()


def _carried(batch: ReducedBatch, checked: Sequence[int], defects: torch.Tensor) -> np.ndarray:
    """How far defects take runs by operators [B, N + 1], RMS over S [m]; not finite where a defect is not.

    Args:
        batch: the runs.
        checked: [c] steps at which defects [B, c, r] were found.
    """
    steps = batch.steps_taken
    good = torch.nan_to_num(defects, nan=0.0, posinf=0.0, neginf=0.0).numpy()
    at = np.arange(steps)
    between = np.stack([np.stack([np.interp(at, checked, column) for column in run.T], 1) for run in good])
    own, found = batch.batch.record.xhat, torch.zeros(len(batch), steps + 1, dtype=torch.float64)
    with torch.no_grad():
        again = batch.span_at(0).pushed(torch.as_tensor(between))
        for span, rows in groupby(range(steps + 1), batch.span_at):
            for part in torch.tensor(list(rows)).split(_ROWS // 2):
                for run in range(len(batch)):
                    both = torch.cat([own[run, part], again[run, part]])
                    one, two = span.at_sample.position(both.to(span.at_sample.dtype)).split(len(part))
                    off = (one - two).double().square().sum(-1).mean(-1).sqrt()  # fp32 overflows in squares
                    found[run, part] = off.cpu()
    found[~torch.isfinite(defects).all(-1).all(-1)] = torch.inf
    return found.numpy()
