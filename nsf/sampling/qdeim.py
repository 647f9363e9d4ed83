"""Sample particles by pivots of the displacement modes (an answer to the paper's future work)."""

from dataclasses import dataclass

import torch
from typing_extensions import override

from nsf.sampling.sampler import UnweightedSampler
from nsf.scalars import number

_CHUNK = 2**25  # values decoded at once
_SNAPSHOTS = 256  # latents that displacement modes are taken from
_RANK = 1e-8  # singular value, of orthonormal modes' rows, below which a direction counts as spanned
_NEWTON = 8  # steps; from below, on a convex function of slope -3/4 or less


@dataclass(frozen=True)
class QdeimSampler(UnweightedSampler):
    """Particles whose rows of the displacement modes are best conditioned: QDEIM, then oversampling.

    With orthonormal modes U [3P, m], amplitudes fitted to the rows of S are wrong by at most 1/σ_min(U_S)
    times what the modes leave out, and both halves keep σ_min large. First come the pivots of a QR
    decomposition of Uᵀ; as S holds whole particles, so does a pivot, the one whose three rows have the
    largest norm once projected off the rows taken before. These end with the rank, after about m/3
    particles. Each further one is that for which `eigenvalue_gain` is largest. No random number is drawn.

    Attributes:
        modes: m, number of displacement modes; cut to their rank.

    Raises:
        ConfigError: modes is not a positive whole number.

    Source: Drmač and Gugercin 2016, a new selection operator for the discrete empirical interpolation
        method (the pivots); Peherstorfer, Drmač and Gugercin 2020, stability of discrete empirical
        interpolation and gappy proper orthogonal decomposition, "GappyPOD+E" (the oversampling). Both take
        scalar rows, here three at once.
    """

    modes: int = 24

    def __post_init__(self):
        super().__post_init__()
        number("sampler.modes", self.modes, 1, whole=True)

    @override
    def choose(self, manifold, candidates, size, device="cpu"):
        components = displacement_components(manifold, self.modes, device).double()
        U = orthonormal(components)[torch.as_tensor(candidates, device=components.device)]
        chosen = pivots(U, size)
        return candidates[[*chosen, *oversampled(U, chosen, size)]]


@torch.no_grad()
def displacement_components(manifold, count: int, device: str | torch.device = "cpu") -> torch.Tensor:
    """Principal components [P, 3, k] [m] of g(X, x̂) over the training latents, k ≤ count, largest first.

    Each is a mode times the standard deviation of its amplitude. A part of the latents, evenly spread
    over the training, is enough for the leading ones.
    """
    M = len(manifold.training_latents)
    latents = manifold.training_latents[torch.linspace(0, M - 1, min(M, _SNAPSHOTS)).long()].to(device)
    chunks = torch.arange(len(manifold.X)).split(max(1, _CHUNK // (3 * len(latents))))

    def deviations(particles: torch.Tensor) -> torch.Tensor:
        x = manifold.restrict(particles, device=device).position(latents)
        return (x - x.mean(0)).permute(1, 2, 0)

    gram = sum(u.T @ u for u in (deviations(particles).flatten(0, 1) for particles in chunks))
    directions = torch.linalg.eigh(gram).eigenvectors.flip(1)[:, :count] / len(latents) ** 0.5
    return torch.cat([deviations(particles) @ directions for particles in chunks])


def orthonormal(components: torch.Tensor) -> torch.Tensor:
    """The modes [P, 3, m] of norm one of displacement components, without those that are round-off."""
    norms = components.square().sum((0, 1)).sqrt()
    above = norms > _RANK * norms.max()
    return components[..., above] / norms[above]


def pivots(U: torch.Tensor, size: int) -> list[int]:
    """At most `size` particles: those of a QR decomposition of Uᵀ with pivoting by particle; U [c, 3, m].

    Fewer come back where their rows span all that U does.
    """
    remaining, chosen, rank = U.clone(), [], 0
    while len(chosen) < size and rank < U.shape[2]:
        best = int(remaining.square().sum((1, 2)).argmax())
        _, singular, rows = torch.linalg.svd(remaining[best], full_matrices=False)
        rows = rows[singular > _RANK]
        if not len(rows):
            break
        remaining -= (remaining @ rows.T) @ rows
        remaining[best] = 0.0  # its round-off
        chosen.append(best)
        rank += len(rows)
    return chosen


def oversampled(U: torch.Tensor, chosen: list[int], size: int) -> list[int]:
    """Further particles, up to `size` with those chosen, each of the largest `eigenvalue_gain`."""
    # In axes of its own, the three rows of a particle are orthogonal.
    # On the host: cuSOLVER fails on as many small matrices as there are particles.
    squares, axes = (part.to(U.device) for part in torch.linalg.eigh((U @ U.mT).cpu()))
    U = axes.mT @ U
    gram = torch.einsum("pim,pin->mn", U[chosen], U[chosen])
    remaining = torch.ones(len(U), dtype=torch.bool, device=U.device)
    remaining[chosen] = False
    added: list[int] = []
    while len(chosen) + len(added) < size:
        values, vectors = torch.linalg.eigh(gram)
        gap = values[1] - values[0] if len(values) > 1 else torch.full_like(values[0], torch.inf)
        gain = eigenvalue_gain(U @ vectors[:, 0], squares, gap)
        best = int(torch.where(remaining, gain, -1.0).argmax())
        gram += U[best].T @ U[best]
        remaining[best] = False
        added.append(best)
    return added


def eigenvalue_gain(along: torch.Tensor, squares: torch.Tensor, gap: torch.Tensor) -> torch.Tensor:
    """How much each particle's rows R raise the smallest eigenvalue of a Gram matrix A, at least.

    With v the eigenvector of the smallest eigenvalue λ and g the gap to the next, A + RᵀR ⪰ λ + g (1 − v vᵀ)
    + RᵀR. The smallest eigenvalue of the last two terms is the smallest root of
    Σ_i (R v)_i² / (1 + (|R_i|² − μ)/g) = μ where the rows R_i are orthogonal; for one row it is in closed
    form that of the source. Newton's method from μ = 0 stays below the root.

    Args:
        along: [c, 3] R v.
        squares: [c, 3] |R_i|².
        gap: g ≥ 0; ∞ for a matrix of one row.

    Returns:
        [c] μ.

    Source: Peherstorfer, Drmač and Gugercin 2020, section 4 (GappyPOD+E), for one row.
    """
    mu = torch.zeros_like(along[:, :1])
    if gap <= 0:
        return mu[:, 0]
    energy = along.square()
    for _ in range(_NEWTON):
        reach = 1 + (squares - mu) / gap
        value = (energy / reach).sum(1, keepdim=True) - mu
        slope = (energy / reach.square()).sum(1, keepdim=True) / gap - 1
        mu = mu - value / slope
    return mu[:, 0]
