"""Continuous interpolation of particle fields: local linear moving least squares over nearest neighbours."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

NEIGHBOURS = 20  # 19 with weight and the one that ends the support: first two shells of a cubic lattice
SOFTENING = 1e-8  # of the squared support radius: bounds the weight at a particle, error there about 1e-8
RIDGE = 1e-10  # of the moment matrix's trace: the slope across a flat neighbourhood is zero, not 0/0
CHUNK_ENTRIES = 1 << 26  # distances held at once


@dataclass(frozen=True)
class Interpolation:
    """f(X_i) = Σ_j weights_ij f(X_j) over the neighbours j of each of n points, and its derivative in X_i.

    Attributes:
        neighbours: training particles [n, k].
        weights: [n, k], dimensionless; they sum to 1.
        gradients: ∂weights/∂X [n, k, 3] 1/m, the exact derivative, the moving support included.
    """

    neighbours: Tensor
    weights: Tensor
    gradients: Tensor

    def value(self, field: Tensor) -> Tensor:
        """Field [P, ...] at the points [n, ...], in float64 on the field's device."""
        return self._apply("nk,nk...->n...", self.weights, field)

    def gradient(self, field: Tensor) -> Tensor:
        """Its derivative [n, ..., 3] in 1/m."""
        return self._apply("nkd,nk...->n...d", self.gradients, field)

    def _apply(self, contraction: str, factors: Tensor, field: Tensor) -> Tensor:
        row_entries = self.neighbours.shape[1] * max(1, field[0].numel())
        rows = max(1, CHUNK_ENTRIES // row_entries)
        parts = zip(factors.split(rows), self.neighbours.split(rows), strict=True)
        return torch.cat(
            [
                torch.einsum(contraction, factor.to(field.device), field[neighbour.to(field.device)].double())
                for factor, neighbour in parts
            ]
        )


def nearest(X: Tensor, particles: Tensor, k: int) -> Tensor:
    """Indices [n, k] of the k particles [P, 3] nearest to each point X [n, 3], nearest first."""
    rows = max(1, CHUNK_ENTRIES // particles.shape[0])
    return torch.cat([_squared(x, particles).topk(k, largest=False).indices for x in X.split(rows)])


def _squared(X: Tensor, particles: Tensor) -> Tensor:
    """Squared distances [n, P]; torch.cdist takes 50 times as long on a GPU."""
    squared = (X[:, :1] - particles[:, 0]).square_()
    for d in (1, 2):
        difference = X[:, d : d + 1] - particles[:, d]
        squared.addcmul_(difference, difference)
    return squared


def local_weights(X: Tensor, neighbours: Tensor) -> Tensor:
    """Weights [n, k] of the neighbours [n, k, 3] (nearest first) in the linear fit around each X [n, 3].

    With q_j = |X_j − X|² / R² and R the distance of the last neighbour, particle j enters the fit with
    w_j = (1 − q_j)² / (q_j + ε). A neighbour enters or leaves the set where its weight is zero, so the result
    is continuous in X; the pole at q = 0 makes it interpolate (up to ε); the fit reproduces linear fields.

    Source: interpolating moving least squares, Lancaster and Salkauskas 1981, with compact support.
    """
    tiny = torch.finfo(X.dtype).tiny ** 0.5
    offsets = neighbours - X[:, None]
    squared = offsets.square().sum(-1)
    support = squared[:, -1:].clamp_min(tiny)
    offsets = offsets / support.sqrt()[..., None]
    q = squared / support
    w = (1 - q).clamp_min(0).square() / (q + SOFTENING)
    # Neighbours all equally far: the support is empty and every one counts alike.
    total = w.sum(-1, keepdim=True)
    w = torch.where(total > 0, w, torch.ones_like(w))
    w = w / w.sum(-1, keepdim=True)
    centre = torch.einsum("nk,nkd->nd", w, offsets)
    spread = offsets - centre[:, None]
    moments = torch.einsum("nk,nkd,nke->nde", w, spread, spread)
    ridge = RIDGE * moments.diagonal(dim1=-2, dim2=-1).sum(-1) + tiny
    moments = moments + ridge[:, None, None] * torch.eye(3, dtype=X.dtype, device=X.device)
    slope = torch.linalg.solve(moments, centre.unsqueeze(-1)).squeeze(-1)
    return w * (1 - torch.einsum("nkd,nd->nk", spread, slope))


def interpolation(X: Tensor, particles: Tensor) -> Interpolation:
    """The interpolation from training particles [P, 3] m to points X [n, 3] m (both float64, one device)."""
    neighbours = nearest(X, particles, min(NEIGHBOURS, particles.shape[0]))
    weights, gradients = [], []
    rows = max(1, CHUNK_ENTRIES // (64 * neighbours.shape[1]))
    for points, near in zip(X.split(rows), neighbours.split(rows), strict=True):
        around = particles[near]
        # One direction at a time: torch 2.13's vmap of linalg.solve has wrong forward derivatives.
        derivatives = [
            torch.func.jvp(lambda point: local_weights(point, around), (points,), (axis.expand_as(points),))  # noqa: B023
            for axis in torch.eye(3, dtype=X.dtype, device=X.device)
        ]
        weights.append(derivatives[0][0])
        gradients.append(torch.stack([derivative for _, derivative in derivatives], -1))
    return Interpolation(neighbours, torch.cat(weights), torch.cat(gradients))
