"""The engine that steps by operators, and what it refuses."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import ClassVar

import numpy as np
import torch
from typing_extensions import override

from nsf.dynamics.batch import Batch
from nsf.dynamics.latent import LatentRecord
from nsf.dynamics.setup import Setup, first_changes
from nsf.dynamics.span import Span, Stages
from nsf.engines.base import Engine
from nsf.engines.operators.model import StepOperators
from nsf.engines.operators.recurrence import Recurrence
from nsf.engines.operators.states import collider_states
from nsf.engines.operators.taught import Taught
from nsf.mpm import Gravity
from nsf.sampling.sampler import SampleSpan


class Operators(Engine):
    """Steps by operators that were taught for one manifold, scene, sample and Δt.

    A step misses that of its teacher by what was not learned; `nsf.deployment` estimates by how much.

    Args:
        model: the operators, in fp64 on the host.
        taught: what they were taught on.
        samples: the sample that they know, by span of time. A sampler that learns from steps of a GPU, which
            adds in any order, may choose another one each time.
    """

    name: ClassVar[str] = "recurrence"
    moves_particles: ClassVar[bool] = False

    def __init__(self, model: StepOperators, taught: Taught, samples: Sequence[SampleSpan]):
        self.model, self.taught, self.samples = model, taught, samples

    @classmethod
    def load(cls, path: Path | str) -> "Operators":
        """Those of a file that `nsf teach` wrote.

        Raises:
            MissingRunError, SchemaError: see `StepOperators.load`.
        """
        return cls(*StepOperators.load(path))

    @override
    def refusal(self, setups: Sequence[Setup]) -> str:
        seen = {id(setup.scene): setup for setup in setups}
        for setup in seen.values():
            if other := self.taught.differing(Taught.of(setup)):
                return f"they were taught on {other}; teach them again with `nsf teach`"
            if np.any(setup.gravity.values) and not self.model.sizes.gravity:
                there = ", ".join(f"{value:g}" for value in setup.gravity.values[0])
                return f"they were taught without gravity, and the scene has [{there}] m/s²"
        return ""

    @override
    def spans(self, batch: Batch) -> Sequence[Span]:
        one = batch.shared
        like = {"dtype": one.dtype, "device": one.torch_device}
        at = [one.manifold.restrict(sets.sample, **like) for sets in one.sets]
        run = OperatorRun(self.model, batch, first_changes(at[0], one.sets[0].sample, batch.setups))
        return [OperatorSpan(batch, sets, sample, run) for sets, sample in zip(one.sets, at, strict=True)]

    @override
    def doubt(self, setup: Setup, gravity: Gravity) -> tuple[float, str]:
        return self.taught.outside(setup.values, np.asarray(gravity.values))


def acting(batch: Batch) -> tuple[torch.Tensor, torch.Tensor]:
    """Gravity [B, N, 3] [m/s²] and state of the colliders [B, N, f] at each step, as now known."""
    one, forcing = batch.shared, batch.forcing
    t, runs = one.dt * np.arange(one.total_steps), range(len(forcing))
    states = [collider_states(forcing.colliders_of(run), one.dt, one.total_steps) for run in runs]
    return torch.as_tensor(forcing.gravity_at(t)), torch.as_tensor(np.stack(states))


class OperatorRun:
    """Where the runs of a batch are, for all spans of time.

    Args:
        model: the operators.
        batch: the runs.
        first: [B, r] what stands for d at t = 0.
    """

    def __init__(self, model: StepOperators, batch: Batch, first: torch.Tensor):
        one = batch.shared
        self._model, self._batch, self._known = model, batch, batch.forcing.version
        self._first, self._record = first.to(one.torch_device), batch.record
        parameters = torch.stack([setup.parameters for setup in batch.setups]).to("cpu", torch.float64)
        self._gravity, self._states = map(_shared, acting(batch))
        self._of = partial(Recurrence, model, parameters, precision=one.precision, device=one.device)
        self.recurrence = self._of(self._gravity, self._states, record=batch.record)

    def take(self, steps: int) -> None:
        """Take steps; what a hand has changed holds from here on."""
        if self._batch.forcing.version != self._known:
            self._known, since = self._batch.forcing.version, int(self._record.row.max())
            self._gravity, self._states = (
                _shared(torch.cat([held[:, :since].expand(len(now), -1, -1), now[:, since:]], 1))
                for held, now in zip((self._gravity, self._states), acting(self._batch), strict=True)
            )
            before = self.recurrence
            self.recurrence = self._of(self._gravity, self._states, record=self._record)
            self.recurrence.latent.copy_(before.latent)
            self.recurrence.change.copy_(before.change)
            self.recurrence.lag.copy_(before.lag)
        self.recurrence.advance(steps)

    def enter(self, first: bool) -> None:
        """Begin with the latents of the record."""
        now, before = (latest.double() for latest in (self._record.now, self._record.before))
        lag = self._lag(int(self._record.row.max()))
        self.recurrence.begin(now, self._first if first else now - before, lag)

    def _lag(self, step: int) -> torch.Tensor:
        """[B, lags] of the recorded runs at a step."""
        return self._model.lags_after(self._record.xhat[:, : step + 1])

    def pushed(self, push: torch.Tensor) -> torch.Tensor:
        """[B, N + 1, r] latents of the same runs with [B, N, r] added to their changes."""
        start, steps = self._record.xhat[:, 0], push.shape[1]
        record = LatentRecord(start, steps, 1)
        again = self._of(self._gravity, self._states, record=record, push=push)
        again.begin(start.double(), self._first)
        again.advance(steps)
        return record.xhat


def _shared(values: torch.Tensor) -> torch.Tensor:
    """Values [B, …] of each run; [1, …] where all are the same."""
    return values[:1] if bool((values == values[:1]).all()) else values


class OperatorSpan(Span):
    """A span of time of runs by operators; S is kept for whoever asks where the sample particles are.

    Args:
        batch, sets, at_sample: as for `Span`.
        run: where the runs are.
    """

    latent_only = True

    def __init__(self, batch: Batch, sets, at_sample, run: OperatorRun):
        super().__init__(batch, sets, at_sample)
        self._run = run

    @property
    @override
    def stages(self) -> Stages:
        return {"recurrence": lambda: self.take(1)}

    @override
    def enter(self, first: bool) -> None:
        self._run.enter(first)

    @override
    def take(self, steps: int) -> None:
        self._run.take(steps)

    def pushed(self, push: torch.Tensor) -> torch.Tensor:
        """As `OperatorRun.pushed`."""
        return self._run.pushed(push)

    @property
    @override
    def nbytes(self) -> int:
        return super().nbytes + self._run.recurrence.nbytes
