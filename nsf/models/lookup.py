"""The engine of models that give the latent vectors of whole runs: a step looks one up."""

from collections.abc import Sequence

import numpy as np
import torch
from typing_extensions import override

from nsf.data import Case
from nsf.dynamics.batch import Batch
from nsf.dynamics.setup import Setup
from nsf.dynamics.span import LatentOnlySpan, Span
from nsf.engines.base import Engine
from nsf.models.base import Model
from nsf.models.inputs import Inputs, Lessons
from nsf.recurrence.engine import first_change
from nsf.recurrence.solids import collider_states


def inputs_of(batch: Batch) -> Inputs:
    """Parameters, start and forcing of a batch, as they are now: a hand may change them."""
    one, forcing = batch.shared, batch.forcing
    t, runs = one.dt * np.arange(one.total_steps), range(len(batch))
    states = [collider_states(forcing.colliders_of(run), one.dt, one.total_steps) for run in runs]
    first = [first_change(one.manifold, s.constants.X, s.initial_velocity, one.dt) for s in batch.setups]
    return Inputs(
        names=tuple(one.manifold.parameter_names),
        parameters=torch.stack([setup.parameters for setup in batch.setups]).double().cpu().numpy(),
        start=torch.stack([setup.xhat for setup in batch.setups]).double().cpu().numpy(),
        first=torch.stack(first).numpy(),
        gravity=np.asarray(forcing.gravity_at(t)),
        solids=np.stack(states),
        dt=one.dt,
    )


def inputs_in(manifold, cases: Sequence[Case], scenes: Sequence, start: np.ndarray) -> Inputs:
    """Parameters, start and forcing of full-order runs.

    Args:
        manifold: trained fields.
        cases: of the runs; scenes: the scene in each, whose gravity may be another than the case has.
        start: [B, r] x̂ at t = 0.
    """
    names, (dt, steps) = tuple(manifold.parameter_names), (scenes[0].dt, scenes[0].steps)
    parameters = np.array([[case[name] for name in names] for case in cases])
    first = [first_change(manifold, s.particles().X, s.initial_velocity(), dt).numpy() for s in scenes]
    return Inputs(
        names=names,
        parameters=parameters.reshape(len(cases), -1),
        start=np.asarray(start, float),
        first=np.stack(first),
        gravity=np.stack([scene.acting_gravity.at(dt * np.arange(steps)) for scene in scenes]),
        solids=np.stack([collider_states(scene.solids, dt, steps) for scene in scenes]),
        dt=dt,
    )


def training_lessons(manifold, scene, cases: Sequence[Case]) -> Lessons:
    """The training runs of a manifold, in their order.

    Args:
        manifold: trained fields.
        scene: of training; cases: those of training.
    """
    xhat = manifold.training_latents.double().cpu().numpy().reshape(len(cases), -1, manifold.latent_dim)
    inputs = inputs_in(manifold, cases, list(map(scene.at, cases)), xhat[:, 0])
    return Lessons(inputs, xhat, xhat[..., :0])


class LatentEngine(Engine):
    """Takes the steps of runs whose latent vectors a model gives all at once.

    Args:
        model: the model.
        fitted: as its `fit` gave it.
    """

    moves_particles = False

    def __init__(self, model: Model, fitted):
        self.model, self._fitted, self.name = model, fitted, model.name

    @override
    def refusal(self, setups: Sequence[Setup]) -> str:
        return ""

    @override
    def spans(self, batch: Batch) -> Sequence[Span]:
        one, table = batch.shared, _Table(self.model, self._fitted, batch)
        like = {"dtype": one.dtype, "device": one.torch_device}
        at = [one.manifold.restrict(sets.sample, **like) for sets in one.sets]
        return [LatentSpan(batch, sets, sample, table) for sets, sample in zip(one.sets, at, strict=True)]


class _Table:
    """x̂ [B, N + 1, r] of the runs of a batch; made again where a hand has changed the forcing."""

    def __init__(self, model: Model, fitted, batch: Batch):
        self._model, self._fitted, self._batch = model, fitted, batch
        self._version, self._xhat = -1, None

    def rows(self) -> torch.Tensor:
        if self._xhat is None or (self._model.knows_forcing and self._batch.forcing.version != self._version):
            self._version = self._batch.forcing.version
            xhat = np.asarray(self._model.run(self._fitted, inputs_of(self._batch)))
            self._xhat = torch.as_tensor(xhat).to(self._batch.record.xhat)
        return self._xhat


class LatentSpan(LatentOnlySpan):
    """A span of time of such runs; S serves those who decode the sample particles."""

    stage = "latent"

    def __init__(self, batch: Batch, sets, at_sample, table: _Table):
        super().__init__(batch, sets, at_sample)
        self._table = table

    @override
    def enter(self, first: bool) -> None:
        """Nothing is carried from one step to the next."""

    @override
    def take(self, steps: int) -> None:
        record, n = self.record, int(self.record.row.max())
        record.xhat[:, n + 1 : n + steps + 1] = self._table.rows()[:, n + 1 : n + steps + 1]
        record.before.copy_(record.xhat[:, n + steps - 1])
        record.now.copy_(record.xhat[:, n + steps])
        record.row.fill_(n + steps)
