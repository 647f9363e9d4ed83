"""The engine that takes the steps of a recurrence: a batch of runs, each by every member."""

from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor
from typing_extensions import override

from nsf.dynamics.batch import Batch
from nsf.dynamics.interop import ReadBack
from nsf.dynamics.setup import Setup
from nsf.dynamics.span import LatentOnlySpan, Span
from nsf.engines.base import Engine
from nsf.recurrence import taught as files
from nsf.recurrence.descent import of_strides
from nsf.recurrence.fitting import check_stride
from nsf.recurrence.form import Form
from nsf.recurrence.loop import Loop
from nsf.recurrence.solids import collider_states
from nsf.recurrence.taught import Taught
from nsf.scenes.identity import physics_hash


class RecurrenceEngine(Engine):
    """Steps by a recurrence that was taught for one manifold, scene and Δt.

    Args:
        form: the recurrence, in fp64 on the host.
        taught: what taught it.
    """

    name: ClassVar[str] = "recurrence"
    moves_particles: ClassVar[bool] = False

    def __init__(self, form: Form, taught: Taught):
        self.form, self.taught = form, taught

    @classmethod
    def load(cls, path: Path | str) -> "RecurrenceEngine":
        """The engine of a file that `nsf teach` wrote.

        Raises:
            MissingRunError, SchemaError: see `nsf.recurrence.taught.load`.
        """
        return cls(*files.load(path))

    @override
    def refusal(self, setups: Sequence[Setup]) -> str:
        for setup in {id(setup.scene): setup for setup in setups}.values():
            other = Taught.of(setup.manifold, physics_hash(setup.scene), setup.dt)
            if differing := self.taught.differing(other):
                return f"it was taught on {differing}; teach again with `nsf teach`"
            if np.any(setup.gravity.values) and not self.form.sizes.gravity:
                acting = ", ".join(f"{value:g}" for value in setup.gravity.values[0])
                return f"it was taught without gravity, and the scene has [{acting}] m/s²"
            check_stride(self.form.stride, setup.total_steps)
        return ""

    @override
    def spans(self, batch: Batch) -> Sequence[Span]:
        one = batch.shared
        like = {"dtype": one.dtype, "device": one.torch_device}
        at = [one.manifold.restrict(sets.sample, **like) for sets in one.sets]
        runs = Runs(self.form, batch)
        return [RecurrenceSpan(batch, sets, sample, runs) for sets, sample in zip(one.sets, at, strict=True)]


def first_change(manifold, X: np.ndarray, velocity: np.ndarray, dt: float) -> Tensor:
    """The change d [r] at t = 0, in fp64 on the host: x̂ of X less x̂ of X − v₀ Δt.

    Args:
        manifold: trained fields.
        X: [P, 3] [m]; velocity: v₀ [P, 3] [m/s].
        dt: length of a stride [s].
    """
    X, v = (
        torch.as_tensor(np.asarray(values, np.float64), device=manifold.X.device) for values in (X, velocity)
    )
    if not v.any():
        return torch.zeros(manifold.latent_dim, dtype=torch.float64)
    now, before = (manifold.encode(x[None])[0].double().cpu() for x in (X, X - dt * v))
    return now - before


def between(nodes: Tensor, first: Tensor, stride: int) -> Tensor:
    """x̂ [..., N k + 1, r] at all steps, of x̂ [..., N + 1, r] at each stride of k.

    From each node to the next one it follows the parabola through these two and the one before them.

    Args:
        nodes: x̂ at strides.
        first: [..., r] the change before the first node.
        stride: k.
    """
    if stride == 1:
        return nodes
    changes = torch.cat([first[..., None, :], torch.diff(nodes, dim=-2)], -2)
    before, after = changes[..., :-1, None, :], changes[..., 1:, None, :]
    part = torch.arange(stride, device=nodes.device, dtype=nodes.dtype)[:, None] / stride
    inside = nodes[..., :-1, None, :] + 0.5 * part * ((before + after) + part * (after - before))
    return torch.cat([inside.flatten(-3, -2), nodes[..., -1:, :]], -2)


class Runs:
    """Where the runs of a batch are, for all spans of time.

    Strides are taken whole, so that the last one may be ahead of the steps that were asked for. A hand that
    changes gravity acts from the next stride on.

    Args:
        form: the recurrence.
        batch: the runs.
    """

    def __init__(self, form: Form, batch: Batch):
        one, k = batch.shared, form.stride
        self._form, self._batch, self._version = form, batch, batch.forcing.version
        self._parameters = torch.stack([s.parameters for s in batch.setups]).to("cpu", torch.float64)
        self._first = torch.stack(
            [first_change(one.manifold, s.constants.X, s.initial_velocity, k * s.dt) for s in batch.setups]
        )
        self._steps, self._done = 0, 0  # taken, and strides
        gravity, features = self._acting()
        self.loop = Loop(form, self._parameters, gravity, features, one.precision, one.device)
        record = batch.record
        record.stress = record.xhat.new_zeros(len(batch), one.total_steps + 1, form.sizes.stress)
        record.read_back = ReadBack(one.device)
        self._write = self.loop.recorder(self._first, record)

    def _acting(self) -> tuple[Tensor, Tensor]:
        """Gravity [B, N, 3] [m/s²] and states of the colliders [B, N, f], as now known, in strides."""
        one, forcing = self._batch.shared, self._batch.forcing
        steps, runs = one.total_steps, range(len(self._batch))
        states = np.stack([collider_states(forcing.colliders_of(k), one.dt, steps) for k in runs], 1)
        gravity = torch.as_tensor(forcing.gravity_at(one.dt * np.arange(steps))).transpose(0, 1)
        acting = gravity, torch.as_tensor(states)
        return tuple(of_strides(values, self._form.stride).transpose(0, 1) for values in acting)

    def enter(self) -> None:
        """Go on from the latent vectors of the record."""
        record, k = self._batch.record, self._form.stride
        self._steps = int(record.row.max())
        self._done = self._steps // k
        path = record.xhat[:, : self._done * k + 1 : k].to(self._first)
        change = self._first if not self._done else path[:, -1] - path[:, -2]
        state = self._form.begin(path[:, -1], change)._replace(stress=self._stress_along(path))
        self.loop.xhat[:, :, : self._done + 1] = path.to(self.loop.xhat)
        self.loop.begin(state, self._done)
        record.read_back.mark()
        self._force(self._done)

    def _stress_along(self, path: Tensor) -> Tensor:
        """ŝ [M, B, n_s] at the end of a way x̂ [B, N + 1, r] from t = 0."""
        form = self._form
        along = [form.begin(path[:, 0], self._first).stress]
        features = form.collider_state(self._acting()[1]) if form.sizes.stress else None
        for n, change in enumerate(torch.diff(path, dim=1).unbind(1) if form.sizes.stress else ()):
            x, d, _ = form.begin(path[:, n], change)
            along.append(form.next_stress(x, d, along[-1], self._parameters, features[:, n]))
        if form.sizes.stress:
            self.loop.stress[:, :, : len(along)] = torch.stack(along, 2).to(self.loop.stress)
        return along[-1]

    def _force(self, since: int) -> None:
        """Let the forcing that is now known act from a stride on."""
        if self._batch.forcing.version != self._version:
            self._version = self._batch.forcing.version
            self.loop.force(since, *self._acting())

    def take(self, steps: int) -> None:
        """Take steps of the full-order Δt."""
        record, begin = self._batch.record, self._steps
        end, strides = begin + steps, -(-(begin + steps) // self._form.stride)
        self._force(self._done)
        if strides > self._done:
            self.loop.advance(self._done, strides - self._done)
            self._done = strides
        self._write(begin, end)
        record.read_back.mark()
        self._steps = end

    def members(self, steps: int) -> Tensor | None:
        """x̂ [M, B, n + 1, r] of members at strides, on the host; None of a single one."""
        if self._form.sizes.members == 1:
            return None
        return self._batch.record.read_back(self.loop.xhat[:, :, : -(-steps // self._form.stride) + 1])

    @property
    def nbytes(self) -> int:
        """Bytes beside the record."""
        return self.loop.nbytes


class RecurrenceSpan(LatentOnlySpan):
    """A span of time of runs by a recurrence; S is there for what asks where the sample particles are.

    Args:
        batch, sets, at_sample: as for `Span`.
        runs: where the runs are.
    """

    stage = "recurrence"

    def __init__(self, batch: Batch, sets, at_sample, runs: Runs):
        super().__init__(batch, sets, at_sample)
        self._runs, self.stride = runs, runs.loop.form.stride

    @override
    def enter(self, first: bool) -> None:
        self._runs.enter()

    @override
    def take(self, steps: int) -> None:
        self._runs.take(steps)

    @override
    def members(self, steps: int) -> Tensor | None:
        return self._runs.members(steps)

    @property
    @override
    def nbytes(self) -> int:
        return super().nbytes + self._runs.nbytes
