"""How far runs of latent vectors alone are from projected runs, estimated from a few projected steps.

Every so many steps a projected step is taken from the run's own state. The difference of both, the defect, is
added to the changes of the run from one such step to the next, and the run is taken once more: how far it has
then moved estimates how far the run is from the projected one.
"""

from collections.abc import Sequence
from itertools import groupby

import numpy as np
import torch

from nsf.dynamics import ReducedBatch

_ROWS = 1024  # latent vectors decoded at once


def estimated_errors(batch: ReducedBatch, projected: ReducedBatch, every: int) -> np.ndarray:
    """Estimated distance of runs from projected ones, [B, N + 1] RMS over S [m].

    It is not finite where a run is not. The residuals of the projected steps are put into the record of the
    runs, for `Trust`.

    Args:
        batch: runs of latent vectors alone, at their end.
        projected: the same runs by projected steps; left in the midst of one.
        every: steps from one projected step to the next.
    """
    steps = batch.steps_taken
    checked = list(range(min(every, steps - 1), steps, every))
    defects = torch.stack([_defect(batch, projected, n) for n in checked], 1)
    return _moved_by(batch, checked, defects)


def _defect(batch: ReducedBatch, projected: ReducedBatch, n: int) -> torch.Tensor:
    """[B, r] projected step from the runs' state after n steps, minus their own step."""
    record, target = batch.batch.record, projected.batch.record
    target.now.copy_(record.xhat[:, n])
    target.before.copy_(record.xhat[:, n - 1])
    target.row.fill_(n)
    target.xhat[:, : n + 1] = record.xhat[:, : n + 1]
    projected.resume(n)
    projected.step(1)
    record.residuals[:, n] = target.residuals[:, n]
    return (target.now - record.xhat[:, n + 1]).double().cpu()


def _moved_by(batch: ReducedBatch, checked: Sequence[int], defects: torch.Tensor) -> np.ndarray:
    """How far defects move runs, [B, N + 1] RMS over S [m]; not finite where a defect is not.

    Args:
        batch: the runs.
        checked: [c] steps of the defects [B, c, r]; between them these are interpolated.
    """
    steps = batch.steps_taken
    finite = torch.nan_to_num(defects, nan=0.0, posinf=0.0, neginf=0.0).numpy()
    n = np.arange(steps)
    pushes = np.stack([np.stack([np.interp(n, checked, column) for column in run.T], 1) for run in finite])
    xhat, errors = batch.batch.record.xhat, torch.zeros(len(batch), steps + 1, dtype=torch.float64)
    with torch.no_grad():
        pushed = batch.span_at(0).pushed(torch.as_tensor(pushes))
        for span, rows in groupby(range(steps + 1), batch.span_at):
            for part in torch.tensor(list(rows)).split(_ROWS // 2):
                for run in range(len(batch)):
                    latents = torch.cat([xhat[run, part], pushed[run, part]])
                    x, x_pushed = span.at_sample.position(latents.to(span.at_sample.dtype)).split(len(part))
                    squares = (x - x_pushed).double().square().sum(-1)  # in fp32 they would overflow
                    errors[run, part] = squares.mean(-1).sqrt().cpu()
    errors[~torch.isfinite(defects).all(-1).all(-1)] = torch.inf
    return errors.numpy()
