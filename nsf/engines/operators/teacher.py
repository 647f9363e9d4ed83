"""The teacher: another engine, stepped in batches from states of one's choice."""

from collections.abc import Callable, Sequence

import numpy as np
import torch
from typing_extensions import override

from nsf.dynamics.setup import first_changes
from nsf.dynamics.solver import ReducedBatch
from nsf.engines.operators.states import collider_states, mirrored_states
from nsf.scenes.symmetry import Image


class Teacher:
    """Runs of another engine in some cases, whose every step may begin where one likes.

    Args:
        batches: the runs at t = 0, in the order of the values; an engine that steps one at a time has a batch
            for each.
        told: called with each number of steps taken.

    Attributes:
        asked: whether its step may begin anywhere, and not along its runs alone.
        parameters: μ [R, n]; start: x̂_0 [R, r]; all in fp64 on the host.
        gravity: [N, R, 3] [m/s²], and features: [N, R, f] state of the colliders, at each step.
        programs: whether the runs follow forcing programs.
        setup: of the first run. total_steps: N; dt: step [s]; steps: how many were taken here.
    """

    asked = True

    def __init__(self, batches: Sequence[ReducedBatch], told: Callable[[int], object] = lambda steps: None):
        self._batches, self._told, self.steps = batches, told, 0
        setups = [setup for batch in batches for setup in batch.batch.setups]
        self.setup = setups[0]
        self.total_steps, self.dt = batches[0].total_steps, batches[0].dt
        self.parameters = _host(torch.stack([setup.parameters for setup in setups]))
        self.programs = bool(self.setup.scene.forcing)
        t = self.dt * np.arange(self.total_steps)
        self.gravity = torch.as_tensor(np.stack([setup.gravity.at(t) for setup in setups], 1))
        self.start = _host(torch.stack([setup.xhat for setup in setups]))
        states = [collider_states(setup.scene.solids, self.dt, self.total_steps) for setup in setups]
        self.features = torch.as_tensor(np.stack(states, 1))

    def __len__(self) -> int:
        return len(self.parameters)

    def first_change(self) -> torch.Tensor:
        """[R, r] what stands for d at t = 0."""
        spans = [(batch.span_at(0), batch.batch.setups) for batch in self._batches]
        return torch.cat([first_changes(span.at_sample, span.sets.sample, own) for span, own in spans])

    def run(self) -> torch.Tensor:
        """[N + 1, R, r] latent vectors of the runs as they go by themselves."""
        found = []
        for batch in self._batches:
            batch.restart()
            batch.step(batch.total_steps)
            found.append(_host(batch.batch.record.xhat))
            self._count(batch.total_steps * len(batch))
        return torch.cat(found).transpose(0, 1)

    def left_grid(self) -> list[bool]:
        """[R] whether each run, which was taken to its end, left the grid."""
        return [run.left_grid() >= 0 for batch in self._batches for run in batch.runs]

    def step_from(
        self, step: int, xhat: torch.Tensor, change: torch.Tensor, gravity: torch.Tensor | None = None
    ) -> torch.Tensor:
        """x̂_{n+1} [R, r] from states of one's choice.

        Args:
            step: n, at least 1; it says where colliders are and which sample holds.
            xhat, change: [R, r] x̂_n and d = x̂_n − x̂_{n−1}.
            gravity: [R, 3] [m/s²] of this step; the scenes' own by default.
        """
        found, first = [], 0
        for batch in self._batches:
            rows = slice(first, first := first + len(batch))
            record = batch.batch.record
            record.now.copy_(xhat[rows])
            record.before.copy_(xhat[rows] - change[rows])
            record.row.fill_(step)
            if step > 1:  # the inversion begins on the parabola through three, here a line
                record.xhat[:, step - 2] = xhat[rows] - 2.0 * change[rows]
            if gravity is not None:
                batch.batch.forcing.set_gravity(gravity[rows].numpy())
            batch.resume(step)
            batch.step(1)
            found.append(_host(record.now))
            batch.batch.forcing.release()
            self._count(len(batch))
        return torch.cat(found)

    def _count(self, steps: int) -> None:
        self.steps += steps
        self._told(steps)


class Recorded(Teacher):
    """Recorded runs in place of steps of an engine: what is learned is how their latent vectors go on.

    Args:
        batches: of the reduced runs in the same cases, at t = 0; none of their steps is taken.
        runs: [N + 1, R, r] latent vectors of the full-order runs, or of projected ones.
    """

    asked = False

    def __init__(self, batches: Sequence[ReducedBatch], runs: torch.Tensor):
        super().__init__(batches)
        self._runs = runs

    @override
    def run(self) -> torch.Tensor:
        return self._runs


class Mirrored(Recorded):
    """Recorded runs and their images in the mirror planes of a scene, which are runs as well.

    Args:
        lesson: the runs.
        images: of the scene, itself first.
        seen: (latent vectors [..., r], image) → those of the image.
    """

    def __init__(
        self, lesson: Recorded, images: Sequence[Image], seen: Callable[[torch.Tensor, Image], torch.Tensor]
    ):
        vars(self).update(vars(lesson))
        start, first = lesson.start, lesson.first_change()
        self.start = torch.cat([seen(start, image) for image in images])
        self._first = self.start - torch.cat([seen(start - first, image) for image in images])
        self._runs = torch.cat([seen(lesson.run(), image) for image in images], 1)
        self.parameters = lesson.parameters.repeat(len(images), 1)
        turned = [lesson.gravity @ torch.as_tensor(image.R).T for image in images]
        states = [mirrored_states(lesson.features.numpy(), image) for image in images]
        self.gravity, self.features = torch.cat(turned, 1), torch.as_tensor(np.concatenate(states, 1))

    @override
    def first_change(self) -> torch.Tensor:
        return self._first


def _host(values: torch.Tensor) -> torch.Tensor:
    return values.detach().to("cpu", torch.float64, copy=True)
