"""Moving least squares between particles."""

import pytest
import torch

from nsf.kinematics.interpolation import NEIGHBOURS, interpolation, lying_together, nearest


def cloud(n, seed=0):
    return torch.rand(n, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


LATTICE = torch.cartesian_prod(*[torch.arange(5.0, dtype=torch.float64)] * 3)
FLAT = cloud(60) * torch.tensor([1.0, 1.0, 0.0], dtype=torch.float64) + 0.3


@pytest.mark.parametrize(
    ("particles", "shift"),
    [(cloud(300), 0.02), (LATTICE, 0.5), (LATTICE, 0.0), (FLAT, 0.0), (cloud(NEIGHBOURS - 7), 0.01)],
    ids=["cloud", "cells", "nodes", "flat", "few"],
)
def test_linear_fields(particles, shift):
    X = particles[:40] + shift
    coefficients = torch.tensor([[1.0, -2.0], [0.5, 3.0], [2.0, 1.0]], dtype=torch.float64)
    local = interpolation(X, particles)
    torch.testing.assert_close(
        local.value(particles @ coefficients + 1), X @ coefficients + 1, rtol=1e-7, atol=1e-7
    )
    slope = local.gradient(particles @ coefficients + 1)
    if particles is FLAT:  # across the plane the slope is unknown: zero
        assert slope[..., 2].abs().max() < 1e-6
        slope, coefficients = slope[..., :2], coefficients[:2]
    torch.testing.assert_close(slope, coefficients.T.expand(len(X), 2, -1), rtol=1e-5, atol=1e-5)


def test_neighbours_are_sorted_once(monkeypatch):
    X, particles = cloud(40, 1), cloud(200)
    one, other = particles.sin(), (3 * particles).sum(1)
    fresh = [interpolation(X, particles).value(field) for field in (one, other)]
    local, sort, sorted_ = interpolation(X, particles), torch.Tensor.unique, []
    monkeypatch.setattr(
        torch.Tensor, "unique", lambda self, **given: sorted_.append(1) or sort(self, **given)
    )
    for field, expected in zip((one, other), fresh, strict=True):
        assert torch.equal(local.value(field), expected)
    assert len(sorted_) == 1


def test_interpolates():
    particles = cloud(200)
    values = torch.sin(7 * particles)
    torch.testing.assert_close(interpolation(particles, particles).value(values), values, rtol=0, atol=1e-6)


def test_continuous_where_neighbours_change():
    particles = cloud(200)
    values = torch.sin(7 * particles)
    line = torch.linspace(0.2, 0.8, 20001, dtype=torch.float64)[:, None] * torch.ones(3, dtype=torch.float64)
    near = nearest(line, particles, NEIGHBOURS).sort(-1).values
    assert (near[1:] != near[:-1]).any(-1).sum() > 20
    # A jump would not shrink with the step (5e-5 in length); slopes are at most some tens.
    path = interpolation(line, particles).value(values)
    assert (path[1:] - path[:-1]).abs().max() < 5e-3


def test_coincident_particles():
    particles = torch.cat([cloud(1).expand(30, 3), cloud(5, seed=1)])
    local = interpolation(particles[[0, 30, 33]], particles)
    assert local.weights.isfinite().all()
    assert local.gradients.isfinite().all()
    torch.testing.assert_close(local.value(particles), particles[[0, 30, 33]], rtol=0, atol=1e-6)


def test_nearest_first():
    X, particles = cloud(50, seed=2), cloud(80)
    reference = (X[:, None] - particles).norm(dim=-1).argsort(-1)
    for k in (1, 5, 80):
        assert torch.equal(nearest(X, particles, k), reference[:, :k])
    assert nearest(X[:0], particles, 5).shape == (0, 5)


@pytest.mark.parametrize(
    "particles",
    [
        cloud(3000),
        cloud(3000) * torch.tensor([1.0, 0.02, 0.5]),
        torch.cat([cloud(1500), cloud(1500) * 0.1 + 4]),
    ],
    ids=["cube", "slice", "clusters"],
)
def test_nearest(particles):
    """Of points inside and outside."""
    particles = particles.double()
    shift = torch.tensor([0.01, 0.7]).repeat_interleave(300)[:, None]
    X = particles[:600] + shift * cloud(600, seed=3)
    reference = (X[:, None] - particles).square().sum(-1).topk(20, largest=False)
    found = nearest(X, particles, 20)
    distances = (X[:, None] - particles[found]).square().sum(-1)
    torch.testing.assert_close(distances, reference.values, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("X", [cloud(5000), cloud(5000) * torch.tensor([1.0, 0.0, 0.3]), cloud(7), cloud(0)])
def test_points_lying_together(X):
    groups = lying_together(X.double(), 100)
    assert torch.equal(torch.cat(groups).sort().values, torch.arange(len(X)))
    assert max(map(len, groups)) <= 100
    if X.any() and len(X) > 100 and X[:, 1].any():  # 50 groups of a cube: most span a fraction of each edge
        spans = torch.stack([X[g].amax(0) - X[g].amin(0) for g in groups])
        assert spans.median(0).values.max() < 0.5
