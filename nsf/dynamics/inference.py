"""Network inference: x, v, τ and C of particles at a latent vector (paper section 5.1)."""

from collections.abc import Callable, Iterator

import torch

from nsf.data import TAU_MATRIX
from nsf.kinematics.manifold import Restriction

#: Sources at n points: of τ, x̂ [r] → [n, 3, 3]; of C, x̂ and dx̂/dt [r] → [n, 3, 3], or None for zero.
StressSource = Callable[[torch.Tensor], torch.Tensor]
AffineSource = Callable[[torch.Tensor, torch.Tensor], torch.Tensor | None]


class Inference:
    """x, v, τ and C at the integration particles N.

    x = g(X, x̂_n), v = (g(X, x̂_n) − g(X, x̂_{n−1})) / Δt, and τ and C from their sources, C with
    dx̂/dt = (x̂_n − x̂_{n−1}) / Δt.

    Args:
        at: the fields restricted to N.
        stress, affine: sources of τ and C (`Sources.stress_of`, `Sources.affine_of`).
        dt: step [s].

    Source: paper section 5.1.
    """

    def __init__(self, at: Restriction, stress: StressSource, affine: AffineSource, dt: float):
        self.at, self.stress, self.affine, self.dt = at, stress, affine, dt
        self.previous = torch.zeros(at.points, 3, dtype=at.dtype, device=at.device)
        self.before = torch.zeros(at.latent_dim, dtype=at.dtype, device=at.device)

    def begin(
        self,
        xhat: torch.Tensor,
        velocity: torch.Tensor | float = 0.0,
        rate: torch.Tensor | float = 0.0,
    ) -> None:
        """Set x̂_{n−1} and the positions there, from which the first difference is taken.

        Args:
            xhat: [r] x̂_{n−1}; at t = 0, where no step came before, x̂_0.
            velocity, rate: at t = 0 the initial velocity [n, 3] [m/s] and the dx̂/dt [r] of it [1/s]; else 0.
        """
        self.previous.copy_(self.at.position(xhat) - self.dt * velocity)
        self.before.copy_(xhat - self.dt * rate)

    def __call__(
        self, xhat: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor | None]:
        """x [n, 3] [m], v [n, 3] [m/s], τ [n, 3, 3] [Pa] and C [n, 3, 3] [1/s], None for zero, at x̂_n [r]."""
        rate = (xhat - self.before) / self.dt
        self.before.copy_(xhat)
        return *self.motion(xhat), self.stress(xhat), self.affine(xhat, rate)

    def motion(self, xhat: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """x [n, 3] [m] and v [n, 3] [m/s] at x̂_n [r]."""
        x = self.at.position(xhat)
        # Backward difference, not the grid velocity: the reduced model has no v field (section 5.1).
        v = (x - self.previous) / self.dt
        self.previous.copy_(x)
        return x, v


class Decoder:
    """x, τ and C at the points of a restriction, from their sources.

    Without a stress field τ comes from ∂g/∂X, without an affine field C is 0: as the run used them, whatever
    further fields the manifold has.

    Args:
        at: fields restricted to n points.
        stress, affine: sources of τ and C, as for `Inference`.
    """

    def __init__(self, at: Restriction, stress: StressSource, affine: AffineSource):
        self.at, self._stress, self._affine = at, stress, affine
        self._expand = torch.tensor(TAU_MATRIX, device=at.device).flatten()
        self._zero = torch.zeros(at.points, 3, 3, dtype=at.dtype, device=at.device)

    def position(self, xhat: torch.Tensor) -> torch.Tensor:
        """x = g(X, x̂), [n, 3] of x̂ [r] or [F, n, 3] of x̂ [F, r], in metres."""
        return self.at.position(xhat)

    def positions(self, xhat: torch.Tensor) -> Iterator[torch.Tensor]:
        """Positions of x̂ [F, r] in blocks of frames; see `Restriction.positions`."""
        return self.at.positions(xhat)

    def stress(self, xhat: torch.Tensor, stress: torch.Tensor | None = None) -> torch.Tensor:
        """τ [F, n, 3, 3] of x̂ [F, r], in pascals; of ŝ [F, n_s], coordinates of τ, where there are any."""
        if stress is None or not stress.shape[-1]:
            if getattr(self._stress, "of_batches", False):
                return self._stress(xhat)
            return torch.stack([self._stress(row).clone() for row in xhat])
        tau = self.at.stress_of(stress.to(self.at.device, self.at.dtype))
        return tau[..., self._expand].unflatten(-1, (3, 3))

    def affine(self, xhat: torch.Tensor, rate: torch.Tensor) -> torch.Tensor:
        """C [F, n, 3, 3] of x̂ and dx̂/dt [F, r], in 1/s."""
        C = self._affine(xhat, rate)
        return self._zero.expand(len(xhat), -1, -1, -1) if C is None else C
