"""Network inference: what the fields say of particles at a latent vector (paper section 5.1)."""

from collections.abc import Callable

import torch

from nsf.kinematics.manifold import Restriction

#: A source of τ or C at n points: x̂ [r] → [n, 3, 3], or None for zero.
Source = Callable[[torch.Tensor], torch.Tensor | None]


class Inference:
    """x, v, τ and C at the integration particles N.

    x = g(X, x̂_n), v = (g(X, x̂_n) − g(X, x̂_{n−1})) / Δt, and τ and C as the method takes them.

    Args:
        at: the fields restricted to N.
        stress, affine: sources of τ and C (`Method.stress_of`, `Method.affine_of`).
        dt: step [s].

    Source: paper section 5.1.
    """

    def __init__(self, at: Restriction, stress: Source, affine: Source, dt: float):
        self.at, self.stress, self.affine, self.dt = at, stress, affine, dt
        self.previous = torch.zeros(at.points, 3, dtype=at.dtype, device=at.device)

    def begin(self, xhat: torch.Tensor, velocity: torch.Tensor | None = None) -> None:
        """Take the positions one step back, from which the next velocity is found.

        Args:
            xhat: [r] x̂_{n−1}; x̂_0 where the velocity is given.
            velocity: [n, 3] initial velocity [m/s]: at t = 0 there is nothing to take a difference of.
        """
        x = self.at.position(xhat)
        self.previous.copy_(x if velocity is None else x - self.dt * velocity)

    def __call__(
        self, xhat: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor | None]:
        """x [n, 3] [m], v [n, 3] [m/s], τ [n, 3, 3] [Pa] and C [n, 3, 3] [1/s], None for zero, at x̂_n [r]."""
        x = self.at.position(xhat)
        # Backward difference, not the grid velocity: the reduced model has no v field (section 5.1).
        v = (x - self.previous) / self.dt
        self.previous.copy_(x)
        return x, v, self.stress(xhat), self.affine(xhat)


class Decoder:
    """x, τ and C at the points of a restriction, as a method takes them.

    Without a stress field τ comes from ∂g/∂X, without an affine field C is 0: what the run used, not what
    the manifold could have given.

    Args:
        at: fields restricted to n points.
        stress, affine: sources of τ and C, as for `Inference`.
    """

    def __init__(self, at: Restriction, stress: Source, affine: Source):
        self.at, self._stress, self._affine = at, stress, affine

    def position(self, xhat: torch.Tensor) -> torch.Tensor:
        """x = g(X, x̂), [n, 3] of x̂ [r] or [F, n, 3] of x̂ [F, r], in metres."""
        return self.at.position(xhat)

    def stress(self, xhat: torch.Tensor) -> torch.Tensor:
        """τ [F, n, 3, 3] of x̂ [F, r], in pascals."""
        return torch.stack([self._stress(row).clone() for row in xhat])

    def affine(self, xhat: torch.Tensor) -> torch.Tensor:
        """C [F, n, 3, 3] of x̂ [F, r], in 1/s."""
        found = [self._affine(row) for row in xhat]
        empty = torch.zeros(self.at.points, 3, 3, dtype=self.at.dtype, device=self.at.device)
        return torch.stack([empty if C is None else C for C in found])
