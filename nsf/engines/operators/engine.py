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


class Operators(Engine):
    """Steps by operators that were taught for one manifold, scene, sample and Δt.

    A step misses that of its teacher by what was not learned; `nsf.deployment` estimates by how much.

    Args:
        model: the operators, in fp64 on the host.
        taught: what they were taught on.
    """

    name: ClassVar[str] = "operators"

    def __init__(self, model: StepOperators, taught: Taught):
        self.model, self.taught = model, taught

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
            if np.any(setup.gravity) and not self.model.sizes.gravity:
                return f"they were taught without gravity, and the scene has {list(setup.gravity)} m/s²"
        return ""

    @override
    def spans(self, batch: Batch) -> Sequence[Span]:
        one = batch.shared
        like = {"dtype": one.dtype, "device": one.torch_device}
        at = [one.manifold.restrict(sets.sample, **like) for sets in one.sets]
        run = OperatorRun(self.model, batch, first_changes(at[0], one.sets[0].sample, batch.setups))
        return [OperatorSpan(batch, sets, sample, run) for sets, sample in zip(one.sets, at, strict=True)]

    @override
    def doubt(self, setup: Setup) -> tuple[float, str]:
        return self.taught.outside(setup.given, setup.gravity)


class OperatorRun:
    """Where the runs of a batch are, for all spans of time.

    Args:
        model: the operators.
        batch: the runs.
        first: [B, r] what stands for d at t = 0.
    """

    def __init__(self, model: StepOperators, batch: Batch, first: torch.Tensor):
        one, setups = batch.shared, batch.setups
        self._first, self._record = first.to(one.torch_device), batch.record
        states = [collider_states(setup.scene.colliders, one.dt, one.total_steps) for setup in setups]
        if all(np.array_equal(states[0], other) for other in states):
            states = states[:1]
        parameters = torch.stack([setup.parameters for setup in setups])
        gravity = torch.tensor(np.array([setup.gravity for setup in setups]), dtype=torch.float64)
        given = parameters.to("cpu", torch.float64), gravity, torch.as_tensor(np.stack(states))
        self._of = partial(Recurrence, model, *given, precision=one.precision, device=one.device)
        self.recurrence = self._of(record=batch.record)

    def enter(self, first: bool) -> None:
        """Begin with the latents of the record."""
        now, before = (latest.double() for latest in (self._record.now, self._record.before))
        self.recurrence.begin(now, self._first if first else now - before)

    def pushed(self, push: torch.Tensor, since: int = 0) -> torch.Tensor:
        """[B, N + 1, r] latents of the same runs from a step on, with [B, N, r] added to their changes."""
        own, steps = self._record.xhat, push.shape[1]
        record = LatentRecord(own[:, 0], steps, 1)
        record.row.fill_(since)
        record.xhat[:, since] = own[:, since]
        again = self._of(record=record, push=push)
        now, before = own[:, since].double(), own[:, max(0, since - 1)].double()
        again.begin(now, now - before if since else self._first)
        again.advance(steps - since)
        return record.xhat


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
        self._run.recurrence.advance(steps)

    def pushed(self, push: torch.Tensor, since: int = 0) -> torch.Tensor:
        """As `OperatorRun.pushed`."""
        return self._run.pushed(push, since)

    @property
    @override
    def nbytes(self) -> int:
        return super().nbytes + self._run.recurrence.nbytes
