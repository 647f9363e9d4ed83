"""A span of time in which the sample stays the same: the particles that a step moves, and their grid."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import ClassVar, NamedTuple

import numpy as np
import torch
import warp as wp
from typing_extensions import override

from nsf.dynamics.batch import Batch
from nsf.dynamics.integration import ParticleSets
from nsf.dynamics.interop import as_matrices, as_scalars, as_vectors
from nsf.dynamics.setup import Setup, first_changes
from nsf.kinematics.manifold import Restriction
from nsf.mpm import Grid, GridStep

#: The stages of one step, in the order of the paper's section 5, by name.
Stages = dict[str, Callable[[], None]]


class Particles(NamedTuple):
    """Rows of a span as Warp sees them, in the order of `GridStep.p2g`."""

    x: wp.array
    v: wp.array
    C: wp.array
    tau: wp.array
    mass: wp.array
    volume0: wp.array


class Span(ABC):
    """Takes the steps of a batch in a span of time; each engine has its own.

    Args:
        batch: the runs.
        sets: S, N and I.
        at_sample: the manifold restricted to S.

    Attributes:
        batch, sets, at_sample: the arguments; record: the batch's.
        s: |S|; size: particles of each run that a step may need; stride: steps that it takes as one.
        latent_only: whether it is a `LatentOnlySpan`.
        capturable: whether a step is the same launches each time; graph: of a step, where it is captured.
    """

    latent_only = False
    capturable = True
    graph = None
    size = 0
    stride = 1

    def __init__(self, batch: Batch, sets: ParticleSets, at_sample: Restriction):
        self.batch, self.record, self.sets = batch, batch.record, sets
        self.at_sample, self.s = at_sample, len(sets.sample)

    @property
    @abstractmethod
    def stages(self) -> Stages:
        """One step, stage by stage, in order."""

    @abstractmethod
    def enter(self, first: bool) -> None:
        """Begin with the latents of the record; `first`: v is the initial velocity, not a difference."""

    def first_rate(self) -> torch.Tensor:
        """[B, r] dx̂/dt at t = 0 [1/s], of the initial velocities; zero where no field depends on it."""
        setup, latents = self.batch.shared, self.at_sample.latent_dim
        if not self.at_sample.takes_rate:
            return torch.zeros(len(self.batch), latents, dtype=setup.dtype, device=setup.torch_device)
        changes = first_changes(self.at_sample, self.sets.sample, self.batch.setups)
        return (changes / setup.dt).to(setup.torch_device, setup.dtype)

    def members(self, steps: int) -> torch.Tensor | None:
        """x̂ [M, B, n + 1, r] at each `stride` up to a step, on the host, of members; None of a single one."""
        return None

    @property
    def mean_sizes(self) -> list[float]:
        """Mean |N| of each run over the steps taken in this span."""
        return [float(self.size)] * len(self.batch)

    @property
    def nbytes(self) -> int:
        """Bytes of arrays and fields on the device."""
        return self.at_sample.nbytes

    @property
    def mode_bytes(self) -> float:
        """Bytes of the modes of one particle that a step reads; 0 where it reads none."""
        return 0.0


class GridSpan(Span):
    """A span whose steps move particles over a grid.

    It holds the arrays that P2G reads and G2P writes: n rows of each run, one run after the other, S first.
    The engine fills them, and finds x̂ from S.

    Args:
        batch, sets, at_sample: as for `Span`.
        order: [n] the particles of N in the order of the rows, S first.

    Attributes:
        order: the argument.
        x, v: [B n, 3] position [m] and velocity [m/s]; G2P moves the first |S| rows of each run.
        C, tau: [B n, 3, 3] affine momentum [1/s] and Kirchhoff stress [Pa].
        mass, volume0, mu, lam: [B n] of the particles [kg, m³, Pa, Pa].
        size: n.
        particles: the rows that P2G reads, as Warp sees them; grid_step: P2G, and G2P of S.
    """

    def __init__(self, batch: Batch, sets: ParticleSets, order: np.ndarray, at_sample: Restriction):
        super().__init__(batch, sets, at_sample)
        self.order = order
        shared = batch.shared
        grid = Grid(shared.geometry, shared.precision, shared.device, sets.nodes, runs=len(batch))
        self.grid_step = GridStep(
            grid, batch.forcing, shared.transfer, shared.dt, shared.precision, shared.device
        )

        def rows(of: Callable[[Setup], np.ndarray | torch.Tensor]) -> torch.Tensor:
            like = {"dtype": shared.dtype, "device": shared.torch_device}
            return torch.cat([torch.as_tensor(of(setup)[order], **like) for setup in batch.setups])

        self.mass, self.volume0 = rows(lambda s: s.constants.mass), rows(lambda s: s.constants.volume0)
        self.mu, self.lam = rows(lambda s: s.constants.mu), rows(lambda s: s.constants.lam)
        self.initial_velocity = rows(lambda s: s.initial_velocity)
        self.x, self.v = (torch.zeros_like(self.initial_velocity) for _ in range(2))
        self.C, self.tau = (self.x.new_zeros(len(self.x), 3, 3) for _ in range(2))
        self.bind(len(self.x))

    def bind(self, n: int) -> None:
        """Show the first n rows of the arrays to Warp."""
        precision = self.batch.shared.precision
        vectors = [as_vectors(a[:n], precision) for a in (self.x, self.v)]
        matrices = [as_matrices(a[:n], precision) for a in (self.C, self.tau)]
        scalars = [as_scalars(a[:n]) for a in (self.mass, self.volume0)]
        self.particles = Particles(*vectors, *matrices, *scalars)
        self.size = n // len(self.batch)

    @property
    @override
    def nbytes(self) -> int:
        arrays = (self.mass, self.volume0, self.mu, self.lam, self.initial_velocity, self.x, self.v)
        arrays += (self.C, self.tau)
        return super().nbytes + self.grid_step.grid.nbytes + sum(a.nbytes for a in arrays)


class LatentOnlySpan(Span):
    """Steps from x̂ to x̂ without particles, many at once; nothing is projected.

    `enter` is called once, not for each span.

    Attributes:
        stage: name of the one stage of a step.
    """

    latent_only = True
    stage: ClassVar[str]

    @property
    @override
    def stages(self) -> Stages:
        return {self.stage: lambda: self.take(1)}

    @abstractmethod
    def take(self, steps: int) -> None:
        """Take steps at once."""
