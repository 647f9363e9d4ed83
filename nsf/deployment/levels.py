"""Three levels of one run: operators, the projected step, the full-order solver.

Every so many steps a projected step is taken from the operators' own state. What the operators missed of it,
the defect, is added to their changes, from one such step to the next, and they run once more: how far this
run is from the first estimates how far the first is from the projected one. Where the estimate passes a
tolerance, or the run leaves what it was taught or trained on, the projected step goes on, and after as many
steps the operators try again. What they miss then adds to what they missed before. With method history
particles carry stress that nobody knows in the midst of a run by operators: there the projected step takes
the whole run anew, from t = 0. Where the projected step is not to be believed either, the full-order solver
goes on, to the end (`nsf.deployment.handover`). Where operators are too far off at validation runs, they take
no step.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import groupby

import numpy as np
import torch

from nsf.data import Case
from nsf.deployment.trust import Trust
from nsf.dynamics import History, ReducedBatch, ReducedMPM

#: Who takes a step.
OPERATORS, PROJECTED, FULL_ORDER = range(3)
LEVELS = ("operators", "projected", "full_order")
#: Share of the tolerance, and of the distrust ratio that is believed, up to which a run is left to operators
#: that pass it later, and below which they try again: who goes on starts well.
_WELL = 0.5
_ROWS = 1024  # latent vectors decoded at once


@dataclass(frozen=True)
class Levels:
    """How runs by operators are watched, and when the projected step goes on, or takes a run anew.

    Attributes:
        projected: cases → runs of the projected step at t = 0.
        every: steps from one projected step to the next.
        tolerance: [m] largest estimated error; None for any.
        on_distrust: whether the projected step goes on where a run is not to be believed.
        near: whether operators were near enough at validation runs; else the projected step takes all runs.
    """

    projected: Callable[[Sequence[Case]], ReducedBatch]
    every: int
    tolerance: float | None = None
    on_distrust: bool = False
    near: bool = True

    def watched(
        self, batch: ReducedBatch, projected: ReducedBatch, trust: Trust
    ) -> list[tuple[ReducedMPM, np.ndarray, np.ndarray]]:
        """Look at runs that operators have taken to their end.

        Args:
            batch: the runs.
            projected: the same runs by projected steps, of `self.projected`; left in the midst of one.
            trust: the estimate of whether to believe a run.

        Returns:
            Of each run: the solver that holds all of it, its estimated error [N + 1] [m], which stays as it
            is while the projected step goes on and is 0 of a run taken anew, and who took each step [N],
            `OPERATORS` or `PROJECTED`.
        """
        estimates = estimated_errors(batch, projected, self.every)
        found = []
        for run, estimate in zip(batch.runs, estimates, strict=True):
            own = self._believed(estimate, _ratios(run, 0, run.steps_taken, trust))
            if self.on_distrust and run.doubt[0] > 1.0:
                own = 0
            by = np.full(run.steps_taken, OPERATORS, np.int8)
            if own == len(by):
                found.append((run, estimate, by))
                continue
            solver = projected.alone(run.index).runs[0]
            if isinstance(solver.setup.method, History):
                found.append(_anew(solver))
            else:
                by[own:] = PROJECTED
                found.append((solver, self._shared(run, solver, estimate, by, trust), by))
        return found

    def _believed(self, estimate: np.ndarray, ratios: np.ndarray) -> int:
        """How many of some steps are left to the operators.

        Args:
            estimate: [n + 1] estimated error after each [m].
            ratios: [n + 1] of distrust.
        """
        steps, beyond = len(estimate) - 1, ~self._within(estimate)
        if beyond.any():
            well = np.inf if self.tolerance is None else _WELL * self.tolerance
            until = int(np.flatnonzero(beyond)[0])
            steps = int(max(np.flatnonzero(estimate[:until] <= well), default=0))
        if self.on_distrust:
            above = np.flatnonzero(ratios > 1.0)
            if len(above):
                steps = min(steps, max(0, int(above[0]) - 1))
        return steps

    def _within(self, estimate: np.ndarray) -> np.ndarray:
        """Which estimated errors are finite and within the tolerance."""
        return np.isfinite(estimate) if self.tolerance is None else estimate <= self.tolerance

    def _shared(
        self, run: ReducedMPM, solver: ReducedMPM, estimate: np.ndarray, by: np.ndarray, trust: Trust
    ) -> np.ndarray:
        """Take a run to its end by projected steps, and by operators wherever these are believed again.

        Args:
            run: by operators, to the end.
            solver: of the same run, by projected steps, at t = 0 and alone in its batch. It gets all steps.
            estimate: [N + 1] of the run [m].
            by: [N] who takes each step: `OPERATORS` for the first ones, which are kept, then `PROJECTED`.
                Where the operators go on it is changed.
            trust: the estimate of whether to believe a run.

        Returns:
            Estimated error [N + 1] [m].
        """
        N, n = len(by), int((by == OPERATORS).sum())
        estimate[0] = 0.0  # of a run that is not finite, all is ∞
        estimate = np.where(np.arange(N + 1) <= n, estimate, estimate[n])
        again = run.together.alone(run.index).runs[0]
        _copy(run, solver, 0, n)
        _stand(solver, n)
        while n < N:
            block = min(self.every, N - n)
            solver.step(block)
            n += block
            if n == N or not self._well(again, solver, n, estimate[n], trust):
                continue
            _copy(solver, again, 0, n)
            _stand(again, n)
            again.step(N - n)
            ahead, ratios = self._ahead(again, solver, n, estimate[n], trust)
            own = self._believed(ahead, ratios)
            if own >= min(self.every, N - n):
                _copy(again, solver, n, n + own)
                by[n : n + own] = OPERATORS
                estimate[n : n + own], estimate[n + own :] = ahead[:own], ahead[own]
                n += own
            if n < N:  # looking ahead has moved the solver
                _stand(solver, n)
        return estimate

    def _well(self, again: ReducedMPM, solver: ReducedMPM, n: int, estimate: float, trust: Trust) -> bool:
        """Whether operators may try again after n steps."""
        if self.tolerance is not None and estimate > _WELL * self.tolerance:
            return False
        if not self.on_distrust:
            return self.tolerance is not None  # else only a run whose estimate overflowed
        return again.doubt[0] <= 1.0 and _ratios(solver, n - 1, n, trust)[-1] <= _WELL

    def _ahead(
        self, again: ReducedMPM, solver: ReducedMPM, since: int, estimate: float, trust: Trust
    ) -> tuple[np.ndarray, np.ndarray]:
        """Look at a run by operators from a step on, until it is no longer believed.

        Args:
            again: the run, which operators have taken from that step to its end.
            solver: of the same run, by projected steps; left in the midst of one.
            since: the step.
            estimate: before it [m].
            trust: the estimate of whether to believe a run.

        Returns:
            Estimated error [m + 1] [m] and distrust ratios [m + 1] after each step that was looked at.
        """
        N, checked, defects = again.steps_taken, [], []
        found, ratios = np.array([estimate]), np.zeros(1)
        while (last := since + len(found) - 1) < N:
            checked.append(min(last + self.every, N) - 1)
            defects.append(_defect(again.together, solver.together, checked[-1]))
            found = estimate + _carried(again.together, checked, torch.stack(defects, 1), since)[0]
            ratios = np.concatenate([ratios, _ratios(again, last, checked[-1] + 1, trust)[1:]])
            if self._believed(found, ratios) < len(found) - 1:
                break
        return found, ratios


def _anew(solver: ReducedMPM) -> tuple[ReducedMPM, np.ndarray, np.ndarray]:
    """Take a run by projected steps from t = 0 to its end.

    Args:
        solver: at t = 0, alone in its batch.

    Returns:
        It, its distance from the projected run, 0 [N + 1] [m], and `PROJECTED` [N].
    """
    steps = solver.total_steps
    solver.step(steps)
    return solver, np.zeros(steps + 1), np.full(steps, PROJECTED, np.int8)


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
    return _carried(batch, checked, defects, 0, steps)


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


def _carried(
    batch: ReducedBatch, checked: Sequence[int], defects: torch.Tensor, since: int, until: int | None = None
) -> np.ndarray:
    """How far defects take runs by operators [B, m + 1], RMS over S [m]; not finite where a defect is not.

    Args:
        batch: the runs.
        checked: [c] steps at which defects [B, c, r] were found.
        since, until: first and last step; the last is that after the last check by default.
    """
    until = checked[-1] + 1 if until is None else until
    good = torch.nan_to_num(defects, nan=0.0, posinf=0.0, neginf=0.0).numpy()
    at = np.arange(until)
    between = np.stack([np.stack([np.interp(at, checked, column) for column in run.T], 1) for run in good])
    own, found = batch.batch.record.xhat, torch.zeros(len(batch), until - since + 1, dtype=torch.float64)
    with torch.no_grad():
        again = batch.span_at(since).pushed(torch.as_tensor(between), since)
        for span, rows in groupby(range(since, until + 1), batch.span_at):
            for part in torch.tensor(list(rows)).split(_ROWS // 2):
                for run in range(len(batch)):
                    both = torch.cat([own[run, part], again[run, part]])
                    one, two = span.at_sample.position(both.to(span.at_sample.dtype)).split(len(part))
                    off = (one - two).double().square().sum(-1).mean(-1).sqrt()  # fp32 overflows in squares
                    found[run, part - since] = off.cpu()
    found[~torch.isfinite(defects).all(-1).all(-1)] = torch.inf
    return found.numpy()


def _ratios(run: ReducedMPM, first: int, last: int, trust: Trust) -> np.ndarray:
    """[last − first + 1] distrust ratios of steps in a run's record."""
    residuals = run.record.residuals[first:last, -1].cpu().numpy()
    return trust.ratios(run.record.xhat[first : last + 1].cpu().numpy(), residuals)


def _copy(source: ReducedMPM, target: ReducedMPM, first: int, last: int) -> None:
    """Put steps of one run into the record of another."""
    target.record.xhat[first : last + 1] = source.record.xhat[first : last + 1]
    target.record.residuals[first:last] = source.record.residuals[first:last]
    target.record.updates[first:last] = 0.0


def _stand(run: ReducedMPM, step: int) -> None:
    """Make a run, the only one of its batch, go on from a step of its record."""
    record = run.record
    record.now.copy_(record.xhat[step])
    record.before.copy_(record.xhat[max(0, step - 1)])
    record.row.fill_(step)
    run.together.resume(step)
