"""Arrays of one phase of time: the particles that a reduced step moves, and their grid."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from typing_extensions import override

from nsf.dynamics.integration import NeighbourSearch, ParticleSets
from nsf.dynamics.interop import as_matrices, as_scalars, as_vectors
from nsf.dynamics.latent import LatentRecord
from nsf.dynamics.projection import GaussNewton, Taylor
from nsf.mpm import GridStep, ParticleConstants, Precision

#: The stages of one step in the order of the paper's section 5: name → what it does.
Stages = dict[str, Callable[[], None]]


@dataclass(frozen=True)
class Setting:
    """What the phases of one solver share.

    Attributes:
        constants: every particle of the scene; initial_velocity: [P, 3] theirs [m/s]; of each simulation.
        record: the latent state; of several simulations together.
        projector: of the inversion.
        dt: step [s].
        precision, dtype, device: of the arrays.
    """

    constants: Sequence[ParticleConstants]
    initial_velocity: Sequence[torch.Tensor]
    record: LatentRecord
    projector: GaussNewton | Taylor
    dt: float
    precision: Precision
    dtype: torch.dtype
    device: torch.device

    @property
    def simulations(self) -> int:
        """How many advance together."""
        return len(self.constants)


class Phase(ABC):
    """What P2G reads and G2P moves; where the values come from is left to the kinds of field.

    Of several simulations the arrays hold n rows of each, one by one.

    Args:
        setting: of the solver.
        sets: S, N and I.
        order: [n] the particles of N in the order of the arrays, S first.
        grid_step: the shared P2G, and G2P of S, which updates nodes on its way.
        at_sample: the manifold restricted to S.

    Attributes:
        order: as given.
        x, v, C, tau: what P2G reads; G2P moves the first |S| rows of x and v of each simulation.
        s: |S|; size: n.
    """

    capturable = True
    graph = None

    def __init__(
        self, setting: Setting, sets: ParticleSets, order: np.ndarray, grid_step: GridStep, at_sample
    ):
        self.s = len(sets.sample)
        self.setting, self.sets, self.order = setting, sets, order
        self.grid_step, self.at_sample = grid_step, at_sample
        dtype, device = setting.dtype, setting.device

        def rows(values: Sequence) -> torch.Tensor:
            return torch.cat(
                [torch.as_tensor(of_one[order], dtype=dtype, device=device) for of_one in values]
            )

        self.mass, self.volume0, self.mu, self.lam = (
            rows([getattr(constants, name) for constants in setting.constants])
            for name in ("mass", "volume0", "mu", "lam")
        )
        self.initial_velocity = rows(setting.initial_velocity)
        n = len(self.mass)
        self.x, self.v = (torch.zeros(n, 3, dtype=dtype, device=device) for _ in range(2))
        self.C, self.tau = (torch.zeros(n, 3, 3, dtype=dtype, device=device) for _ in range(2))
        self.bind(n)

    def bind(self, n: int) -> None:
        """Show the first n rows of the arrays to Warp."""
        precision = self.setting.precision
        vectors = [as_vectors(a[:n], precision) for a in (self.x, self.v)]
        matrices = [as_matrices(a[:n], precision) for a in (self.C, self.tau)]
        scalars = [as_scalars(a[:n]) for a in (self.mass, self.volume0)]
        self._integration = (*vectors, *matrices, *scalars)
        self.size = n // self.setting.simulations

    @property
    @abstractmethod
    def stages(self) -> Stages:
        """One step, stage by stage, in order."""

    @abstractmethod
    def enter(self, first: bool) -> None:
        """Begin with the latents of the record; `first`: v is the initial velocity, not a difference."""

    @property
    def mean_sizes(self) -> list[float]:
        """Mean |N| of each simulation over the steps taken in this phase."""
        return [float(self.size)] * self.setting.simulations

    @property
    def nbytes(self) -> int:
        """Bytes of arrays and fields on the device."""
        own = (self.mass, self.volume0, self.mu, self.lam, self.initial_velocity, self.x, self.v)
        own += (self.C, self.tau)
        return self.at_sample.nbytes + self.grid_step.grid.nbytes + sum(a.nbytes for a in own)

    @property
    def mode_bytes(self) -> float:
        """Bytes of the modes of one particle that a step reads; 0 where it reads none."""
        return 0.0

    def p2g(self) -> None:
        """N → grid (paper section 5.2)."""
        self.grid_step.p2g(*self._integration)

    def g2p(self) -> None:
        """Grid → S, where nodes are updated only as S needs them."""
        self.grid_step.follow()
        self._move_sample()

    def _move_sample(self) -> None:
        self.grid_step.update_g2p(*self._integration[:2], self.s)


class DecodedPhase(Phase):
    """Fields of any kind, evaluated by torch at every particle of N; nothing is searched during a run.

    Args:
        at: the manifold restricted to N in the order of the sets.
        stress, affine: sources of τ and C at N; `affine` gives None for C = 0.
        weights: [s] of S in the projection; None for all one.
    """

    def __init__(
        self,
        setting: Setting,
        sets: ParticleSets,
        grid_step: GridStep,
        at,
        stress: Callable,
        affine: Callable,
        weights: np.ndarray | None,
    ):
        super().__init__(setting, sets, sets.integration, grid_step, at.subset(slice(0, len(sets.sample))))
        self.at, self.weights = at, None
        if weights is not None:
            self.weights = torch.as_tensor(
                weights / np.mean(weights), dtype=setting.dtype, device=setting.device
            )
        self.previous = torch.zeros_like(self.x)
        self._stress, self._affine = stress(at, self.mu, self.lam), affine(at)

    @property
    @override
    def stages(self) -> Stages:
        return {
            "inference": self.infer,
            "transfer": self.load,
            "p2g": self.p2g,
            "g2p": self.g2p,
            "inversion": self.invert,
        }

    @override
    def enter(self, first: bool) -> None:
        if first:
            self.previous.copy_(
                self.at.position(self.setting.record.now) - self.setting.dt * self.initial_velocity
            )
        else:
            self.previous.copy_(self.at.position(self.setting.record.before))

    @property
    @override
    def nbytes(self) -> int:
        weights = 0 if self.weights is None else self.weights.nbytes
        shared = self.at_sample.nbytes  # S is a part of N
        return super().nbytes - shared + self.at.nbytes + self.previous.nbytes + weights

    def infer(self) -> None:
        """x [n, 3], τ and C [n, 3, 3] at N (paper section 5.1)."""
        xhat = self.setting.record.now
        self._fields = self.at.position(xhat), self._stress(xhat), self._affine(xhat)

    def load(self) -> None:
        """Field values → the arrays that torch and Warp share."""
        x, tau, C = self._fields
        self.x.copy_(x)
        # Backward difference, not the grid velocity: the reduced model has no v field (section 5.1).
        torch.sub(x, self.previous, out=self.v).div_(self.setting.dt)
        self.previous.copy_(x)
        self.tau.copy_(tau)
        if C is not None:
            self.C.copy_(C)

    def invert(self) -> None:
        """x̂_{n+1} from the new positions of S (paper section 5.3)."""
        record, projector = self.setting.record, self.setting.projector
        start = projector.start(record)
        result = projector.solve(self.at_sample, self.x[: self.s], start, self.weights)
        record.add(result)


class SearchingPhase(DecodedPhase):
    """S fixed, N searched at each step exactly as in the paper (section 5.4, a and b).

    Its sets hold every particle, S first; the fields are evaluated everywhere and the
    particles that S needs are moved to the front of the arrays.
    """

    capturable = False

    def __init__(self, *arguments, search: NeighbourSearch):
        super().__init__(*arguments)
        self._search = search
        self._masses = self.mass.clone(), self.volume0.clone()
        self._sample_rows = torch.arange(self.s, device=self.x.device)
        self._sizes = []

    @property
    @override
    def mean_sizes(self) -> list[float]:
        return [float(np.mean(self._sizes))] if self._sizes else super().mean_sizes

    @override
    def load(self) -> None:
        """Field values of the needed particles → the shared arrays."""
        x, tau, C = self._fields
        needed = self._search.needed(x, self._sample_rows)
        needed[: self.s] = True
        rows = needed.nonzero().flatten()
        n = len(rows)
        self.x[:n] = x[rows]
        self.v[:n] = (x[rows] - self.previous[rows]) / self.setting.dt
        self.previous.copy_(x)
        self.tau[:n] = tau[rows]
        self.C[:n] = 0.0 if C is None else C[rows]
        self.mass[:n], self.volume0[:n] = (values[rows] for values in self._masses)
        self.bind(n)
        self._sizes.append(n)
