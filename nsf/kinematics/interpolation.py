"""Continuous interpolation of particle fields: local linear moving least squares over nearest neighbours."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import torch
import torch.nn.functional as F
from torch import Tensor

NEIGHBOURS = 20  # 19 with weight and the one that ends the support: first two shells of a cubic lattice
SOFTENING = 1e-8  # of the squared support radius: bounds the weight at a particle, error there about 1e-8
RIDGE = 1e-10  # of the moment matrix's trace: the slope across a flat neighbourhood is zero, not 0/0
CHUNK_ENTRIES = 1 << 26  # numbers of a fit held at once


@dataclass(frozen=True)
class Interpolation:
    """f(X_i) = Σ_j weights_ij f(X_j) over the neighbours j of each of n points, and its derivative in X_i.

    Attributes:
        X: points [n, 3] m; particles: [P, 3] m, both float64 on one device.
        neighbours: of the points among the particles [n, k].
        weights: [n, k], dimensionless; they sum to 1.
    """

    X: Tensor
    particles: Tensor
    neighbours: Tensor
    weights: Tensor

    @cached_property
    def gradients(self) -> Tensor:
        """∂weights/∂X [n, k, 3] 1/m, the exact derivative, the moving support included; made on first use."""
        chunks = _chunks(self.X, self.neighbours)
        return torch.cat([_gradients(x, self.particles[near]) for x, near in chunks])

    @cached_property
    def _used(self) -> tuple[Tensor, Tensor]:
        """Indices [used] of the particles that are a neighbour of some point, and each neighbour's place
        among them [n, k]. To sort all neighbours takes longer than a sum."""
        return self.neighbours.unique(return_inverse=True)

    def value(self, field: Tensor) -> Tensor:
        """Field [P, ...] at the points [n, ...], in float64 on the field's device."""
        # Sums rows as it reads them: to hold every point's neighbours first takes six times as long on a CPU.
        near, rows, weights = (part.to(field.device) for part in (*self._used, self.weights))
        values = field[near].double().reshape(len(near), -1)
        sums = F.embedding_bag(rows, values, mode="sum", per_sample_weights=weights)
        return sums.reshape(len(rows), *field.shape[1:])

    def gradient(self, field: Tensor) -> Tensor:
        """Its derivative [n, ..., 3] in 1/m."""
        row_entries = self.neighbours.shape[1] * max(1, field[0].numel())
        rows = max(1, CHUNK_ENTRIES // row_entries)
        parts = zip(self.gradients.split(rows), self.neighbours.split(rows), strict=True)
        return torch.cat(
            [
                torch.einsum(
                    "nkd,nk...->n...d", factor.to(field.device), field[near.to(field.device)].double()
                )
                for factor, near in parts
            ]
        )


def nearest(X: Tensor, particles: Tensor, k: int) -> Tensor:
    """Indices [n, k] of the k particles [P, 3] nearest to each point X [n, 3], nearest first.

    Found on the host, by as many threads as torch has.
    """
    from scipy.spatial import cKDTree  # 0.2 s that commands without points of their own need not pay

    ranks = range(1, k + 1)
    _, indices = cKDTree(particles.cpu().numpy()).query(
        X.cpu().numpy(), ranks, workers=torch.get_num_threads()
    )
    return torch.as_tensor(indices, dtype=torch.long, device=X.device)


def lying_together(X: Tensor, count: int) -> tuple[Tensor, ...]:
    """Rows of the points X [n, 3] in groups of `count`, each from one part of space."""
    if len(X) <= count:
        return (torch.arange(len(X), device=X.device),)
    extent = X.amax(0) - X.amin(0)
    tiny = torch.finfo(X.dtype).tiny ** 0.25
    edge = (extent.clamp_min(1e-6 * extent.max()).prod() * count / len(X)) ** (1 / 3) + tiny
    x, y, z = ((X - X.amin(0)) / edge).unbind(1)
    # Columns of cells one after the other, there and back, so that a group that ends one begins the next.
    i, j = x.floor(), y.floor()
    columns = j.amax() + 1
    column = i * columns + torch.where(i % 2 == 0, j, columns - 1 - j)
    height = z / (z.amax() + 1)
    return (column + torch.where(column % 2 == 0, height, 1 - height)).argsort().split(count)


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
    weights = [local_weights(x, particles[near]) for x, near in _chunks(X, neighbours)]
    return Interpolation(X, particles, neighbours, torch.cat(weights))


def _chunks(X: Tensor, neighbours: Tensor) -> Iterator[tuple[Tensor, Tensor]]:
    """Points and their neighbours, as many at once as the fit's matrices leave room for."""
    rows = max(1, CHUNK_ENTRIES // (64 * neighbours.shape[1]))
    return zip(X.split(rows), neighbours.split(rows), strict=True)


def _gradients(X: Tensor, neighbours: Tensor) -> Tensor:
    """Derivative [n, k, 3] of `local_weights` in X."""
    # One direction at a time: torch 2.13's vmap of linalg.solve has wrong forward derivatives.
    derivatives = [
        torch.func.jvp(lambda point: local_weights(point, neighbours), (X,), (axis.expand_as(X),))[1]
        for axis in torch.eye(3, dtype=X.dtype, device=X.device)
    ]
    return torch.stack(derivatives, -1)
