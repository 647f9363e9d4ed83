"""Arrays of one phase of time: the particles that a reduced step moves, and their grid."""

from collections.abc import Callable

import numpy as np
import torch

from nsf.dynamics.integration import NeighbourSearch, ParticleSets
from nsf.dynamics.interop import as_matrices, as_scalars, as_vectors
from nsf.mpm import Grid, GridStep, ParticleConstants, Precision


class Phase:
    """Fixed S, N and I: nothing is searched during a run.

    Args:
        sets: S, N (S first) and I.
        at: the manifold restricted to N.
        constants: every particle of the scene.
        grid_step: builds the shared P2G, grid update and G2P on a grid.
        stress: source of τ at N, from the Lamé parameters mu, lam [n].
        affine: source of C at N; gives None for C = 0.
        weights: [s] of S in the projection; None for all one.

    Attributes:
        weights: [s] the same, of mean one.
        previous: [n, 3] positions of N one step back.
        x, v, C, tau: what P2G reads; the first |S| rows are what G2P moves.
    """

    capturable = True

    def __init__(
        self,
        sets: ParticleSets,
        at,
        constants: ParticleConstants,
        grid: Grid,
        grid_step: GridStep,
        stress: Callable,
        affine: Callable,
        precision: Precision,
        dtype: torch.dtype,
        device: torch.device,
        weights: np.ndarray | None = None,
    ):
        n, self.s = len(sets.integration), len(sets.sample)
        self.sets, self.at, self.at_sample = sets, at, at.subset(slice(0, self.s))
        self.grid, self.grid_step, self.precision = grid, grid_step, precision
        self.weights = None
        if weights is not None:
            self.weights = torch.as_tensor(weights / np.mean(weights), dtype=dtype, device=device)

        def rows(values: np.ndarray) -> torch.Tensor:
            return torch.as_tensor(values[sets.integration], dtype=dtype, device=device)

        self.mass, self.volume0 = rows(constants.mass), rows(constants.volume0)
        self._stress, self._affine = stress(at, rows(constants.mu), rows(constants.lam)), affine(at)
        self.x, self.v, self.previous = (torch.zeros(n, 3, dtype=dtype, device=device) for _ in range(3))
        self.C, self.tau = (torch.zeros(n, 3, 3, dtype=dtype, device=device) for _ in range(2))
        self.increment = torch.zeros(self.s, 3, 3, dtype=dtype, device=device)
        self.graph = None
        self.bind(n)

    def bind(self, n: int) -> None:
        """Show the first n rows to Warp."""
        vectors = [as_vectors(a[:n], self.precision) for a in (self.x, self.v)]
        matrices = [as_matrices(a[:n], self.precision) for a in (self.C, self.tau)]
        scalars = [as_scalars(a[:n]) for a in (self.mass, self.volume0)]
        self._integration = (*vectors, *matrices, *scalars)
        vectors = [as_vectors(a[: self.s], self.precision) for a in (self.x, self.v)]
        self._sample = (
            *vectors,
            as_matrices(self.C[: self.s], self.precision),
            as_matrices(self.increment, self.precision),
        )
        self.size = n

    @property
    def nbytes(self) -> int:
        """Bytes of arrays and fields on the device."""
        own = (self.mass, self.volume0, self.x, self.v, self.previous, self.C, self.tau, self.increment)
        weights = 0 if self.weights is None else self.weights.nbytes
        return self.at.nbytes + self.grid.nbytes + sum(a.nbytes for a in own) + weights

    def fields(self, xhat: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor | None]:
        """x [n, 3], τ and C [n, 3, 3] at N (paper section 5.1)."""
        return self.at.position(xhat), self._stress(xhat), self._affine(xhat)

    def load(self, x: torch.Tensor, tau: torch.Tensor, C: torch.Tensor | None, dt: float) -> None:
        """Field values → the arrays that torch and Warp share."""
        self.x.copy_(x)
        # Backward difference, not the grid velocity: the reduced model has no v field (section 5.1).
        torch.sub(x, self.previous, out=self.v).div_(dt)
        self.previous.copy_(x)
        self.tau.copy_(tau)
        if C is not None:
            self.C.copy_(C)
        else:
            self.C.zero_()

    def p2g(self) -> None:
        """N → grid."""
        self.grid_step.p2g(*self._integration)

    def g2p(self) -> None:
        """Grid → S."""
        self.grid_step.g2p(*self._sample)


class SearchingPhase(Phase):
    """S fixed, N searched at each step exactly as in the paper (section 5.4, a and b).

    Its sets hold every particle, S first; the fields are evaluated everywhere and the
    particles that S needs are moved to the front of the arrays.
    """

    capturable = False

    def __init__(self, *arguments, search: NeighbourSearch, **named):
        super().__init__(*arguments, **named)
        self._search = search
        self._masses = self.mass.clone(), self.volume0.clone()
        self._sample_rows = torch.arange(self.s, device=self.x.device)

    def load(self, x: torch.Tensor, tau: torch.Tensor, C: torch.Tensor | None, dt: float) -> None:
        """Field values of the needed particles → the shared arrays."""
        needed = self._search.needed(x, self._sample_rows)
        needed[: self.s] = True
        rows = needed.nonzero().flatten()
        n = len(rows)
        self.x[:n] = x[rows]
        self.v[:n] = (x[rows] - self.previous[rows]) / dt
        self.previous.copy_(x)
        self.tau[:n] = tau[rows]
        self.C[:n] = 0.0 if C is None else C[rows]
        self.mass[:n], self.volume0[:n] = (values[rows] for values in self._masses)
        self.bind(n)
