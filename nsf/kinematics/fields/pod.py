"""Proper orthogonal decomposition of snapshots whose frames are far fewer than their values."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

from nsf.data import Snapshots

#: Snapshots up to which `decompose` finds all its eigenvalues: at 8,000 a quarter of an hour on a core.
MOST_SOLVED = 6000
# Of the subspace iteration: turns, and columns beyond the modes that are wanted.
_TURNS, _MORE = 6, 20
# Eigenvalues below this share of the largest are round-off: snapshots are float32, six digits of amplitude.
RANK_TOLERANCE = 1e-12
#: Fields whose modes are those of deviations from zero, their value at rest, in place of the mean.
FROM_ZERO = ("tau",)


def slabs(snapshots: Snapshots, name: str) -> Iterator[tuple[slice, Tensor, Tensor]]:
    """Particle slabs of a field: (particles, mean [n, c], deviations from it [M, n, c]) in float64.

    Of a field in `FROM_ZERO` the mean is given as zero.
    """
    for particles, values in snapshots.slabs(name):
        values = values.double()
        mean = torch.zeros_like(values[0]) if name in FROM_ZERO else values.mean(0)
        yield particles, mean, values - mean


def decompose(snapshots: Snapshots, name: str, count: int) -> Tensor:
    """Coefficients of the snapshots in their leading modes.

    With deviations A [M, P c] (`slabs`): A Aᵀ = V diag(w) Vᵀ, coefficients a = V √w, and the modes are
    B = Aᵀ a / w, so that A ≈ a Bᵀ with B orthonormal. The M×M Gram matrix is summed over particle slabs. Of
    more than `MOST_SOLVED` the leading V and w are found by subspace iteration (Halko, Martinsson and Tropp
    2011, algorithm 4.4), which asks for products with the Gram matrix alone.

    Args:
        snapshots: of every training frame.
        name: field of the snapshots.
        count: modes wanted; fewer come back if the snapshots have a lower numerical rank.

    Returns:
        a [M, K] float64, largest mode first, in the field's unit times √(P c).
    """
    if snapshots.M <= MOST_SOLVED:
        energies, vectors = torch.linalg.eigh(_gram(snapshots, name))
    else:
        energies, vectors = _iterated(snapshots, name, count)
    energies, vectors = energies.flip(0), vectors.flip(1)
    rank = int((energies > RANK_TOLERANCE * energies[0].clamp_min(torch.finfo(torch.float64).tiny)).sum())
    modes = min(count, rank)
    return vectors[:, :modes] * energies[:modes].sqrt()


def _gram(snapshots: Snapshots, name: str) -> Tensor:
    """A Aᵀ [M, M] of a field's deviations A [M, P c] (`slabs`)."""
    G = torch.zeros(snapshots.M, snapshots.M, dtype=torch.float64, device=snapshots.X.device)
    for _, _, deviations in slabs(snapshots, name):
        rows = deviations.flatten(1)
        G.addmm_(rows, rows.T)
    return G


def _iterated(snapshots: Snapshots, name: str, count: int) -> tuple[Tensor, Tensor]:
    """Leading w, the largest last, and V of the Gram matrix, which is not formed."""
    generator = torch.Generator().manual_seed(0)
    shape = snapshots.M, min(count + _MORE, snapshots.M)
    V = torch.randn(shape, generator=generator, dtype=torch.float64).to(snapshots.X.device)
    for _ in range(_TURNS):
        Q, V = torch.linalg.qr(V).Q, torch.zeros_like(V)
        for _, _, deviations in slabs(snapshots, name):
            rows = deviations.flatten(1)
            V.addmm_(rows, rows.T @ Q)
    energies, turn = torch.linalg.eigh(Q.T @ V)
    return energies, Q @ turn


def modes(snapshots: Snapshots, name: str, coefficients: Tensor) -> Iterator[tuple[slice, Tensor, Tensor]]:
    """Slab by slab: (particles, mean [n, c], modes [n, c, K]) in float64, for coefficients [M, K]."""
    projection = coefficients / coefficients.square().sum(0)
    for particles, mean, deviations in slabs(snapshots, name):
        yield particles, mean, torch.einsum("mnc,mk->nck", deviations, projection)
