"""What is added to x̂ after a step was projected, for the runs of a batch."""

import copy

import torch

from nsf.dynamics.batch import Batch
from nsf.dynamics.latent import LatentRecord
from nsf.engines.closed.linear import Known
from nsf.engines.operators.engine import acting
from nsf.engines.operators.model import StepOperators
from nsf.engines.operators.recurrence import Recurrence


class Closure:
    """c(x̂_n, d_n, μ, g_n) of each run, by the compiled loop of operators.

    Args:
        model: c, as operators of which a step would be x̂ + d + c.
        batch: the runs.
        first: [B, r] what stands for d at t = 0.
    """

    def __init__(self, model: StepOperators, batch: Batch, first: torch.Tensor):
        one = batch.shared
        self._batch, self._record, self._known = batch, batch.record, batch.forcing.version
        self._first = first.to(one.torch_device, torch.float64)
        self._change = self._first.clone()
        self._decayed = copy.deepcopy(model).to(one.torch_device)  # of which the memory alone is asked here
        self._lag = self._change.new_zeros(len(self._change), model.sizes.lags)
        self._beside = LatentRecord(batch.record.now, one.total_steps, 1)  # the record of x̂ + d + c
        parameters = torch.stack([setup.parameters for setup in batch.setups]).to("cpu", torch.float64)
        where = {"precision": one.precision, "device": one.device}
        self._loop = Recurrence(model, parameters, *acting(batch), record=self._beside, **where)
        manifold = one.manifold
        runs = manifold.training_latents.unflatten(0, (int(manifold.training_trajectories[-1]) + 1, -1))
        self._within = Known.of(runs.transpose(0, 1)).to(one.torch_device, torch.float64)
        self._rows = torch.arange(len(batch), device=one.torch_device)

    def refresh(self) -> None:
        """Take what a hand has changed since; before a step, for a captured one cannot ask."""
        if self._batch.forcing.version != self._known:
            self._known = self._batch.forcing.version
            self._loop.follow(*acting(self._batch))

    def begin(self, first: bool) -> None:
        """Go on from the latents of the record; `first`: at t = 0."""
        now, before = self._record.now, self._record.before
        self._change.copy_(self._first if first else now.double() - before.double())
        known = self._record.xhat[:, : int(self._record.row.max()) + 1]
        self._lag.copy_(self._decayed.lags_after(known))

    def add(self) -> None:
        """Add c to the x̂_{n+1} that was recorded last."""
        record, loop = self._record, self._loop
        self._beside.row.copy_(record.row - 1)
        xhat, change = self._within.within(record.before.double(), self._change)
        loop.begin(xhat, change, self._lag)
        loop.advance(1)
        record.now += loop.change.view_as(change) - change
        record.xhat[self._rows, record.row] = record.now
        self._change.copy_(record.now.double() - record.before.double())
        self._lag.copy_(self._decayed.next_lag(self._lag, self._change))

    @property
    def nbytes(self) -> int:
        """Bytes on the device."""
        return self._loop.nbytes + self._beside.nbytes
