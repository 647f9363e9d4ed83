"""Sample particles by pivots of the displacement modes."""

import numpy as np
import pytest
import torch

from nsf.errors import ConfigError
from nsf.sampling import QdeimSampler
from nsf.sampling.qdeim import displacement_components, eigenvalue_gain, orthonormal, oversampled, pivots

MODES = 8  # all that the tiny manifold has


@pytest.fixture(scope="module")
def U(tiny_manifold):
    """Orthonormal displacement modes [500, 3, 8]."""
    return orthonormal(displacement_components(tiny_manifold, MODES).double())


def smallest(U, particles) -> float:
    """σ_min of the rows of some particles."""
    return float(torch.linalg.svdvals(U[torch.as_tensor(particles)].flatten(0, 1))[-1])


def test_the_modes_are_orthonormal(U):
    rows = U.flatten(0, 1)
    assert torch.allclose(rows.T @ rows, torch.eye(U.shape[2], dtype=rows.dtype), atol=1e-5)


def test_modes_that_are_round_off_are_left_out():
    components = torch.zeros(4, 3, 3, dtype=torch.float64)
    components[0, 0, 0], components[1, 1, 1], components[2, 2, 2] = 1.0, 1e-3, 1e-12
    assert orthonormal(components).shape == (4, 3, 2)


def test_on_scalar_rows_they_are_the_pivots_of_qr():
    """Particles that move along one axis alone have one row: then this is Drmač and Gugercin's choice."""
    linalg = pytest.importorskip("scipy.linalg")
    rows = np.linalg.qr(np.random.default_rng(0).standard_normal((40, 6)))[0]
    U = torch.zeros(40, 3, 6, dtype=torch.float64)
    U[:, 1] = torch.as_tensor(rows)
    *_, order = linalg.qr(rows.T, pivoting=True, mode="economic")
    assert pivots(U, 40) == order[:6].tolist()


def test_pivots_end_where_their_rows_span_the_modes(U):
    chosen = pivots(U, 500)
    assert MODES // 3 <= len(chosen) <= MODES
    assert smallest(U, chosen) > 1e-6
    assert pivots(U, 2) == chosen[:2]


@pytest.mark.parametrize("size", [8, 30, 100])
def test_they_are_better_conditioned_than_any_of_many_random_samples(tiny_manifold, U, size):
    chosen = QdeimSampler(size, modes=MODES).spans_of(tiny_manifold)[0].particles
    draws = [np.random.default_rng(seed).permutation(500)[:size] for seed in range(200)]
    assert smallest(U, chosen) > max(smallest(U, draw) for draw in draws)


def test_the_gain_is_that_of_the_bound(U):
    """It is the smallest eigenvalue of λ + g (1 − v vᵀ) + RᵀR over λ, which A + RᵀR is at least."""
    chosen = pivots(U, 500)
    A = torch.einsum("pim,pin->mn", U[chosen], U[chosen])
    values, vectors = torch.linalg.eigh(A)
    v, gap = vectors[:, 0], values[1] - values[0]
    squares, axes = torch.linalg.eigh(U @ U.mT)
    gain = eigenvalue_gain(axes.mT @ U @ v, squares, gap)
    RR = U.mT @ U
    bound = gap * (torch.eye(MODES, dtype=A.dtype) - torch.outer(v, v))
    assert torch.allclose(gain, torch.linalg.eigvalsh(bound + RR)[:, 0], rtol=1e-6, atol=1e-12)
    assert (gain <= torch.linalg.eigvalsh(A + RR)[:, 0] - values[0] + 1e-12).all()


def test_the_gain_of_one_row_is_in_closed_form():
    """Peherstorfer, Drmač and Gugercin's: (g + |u|² − √((g + |u|²)² − 4 g (v·u)²))/2."""
    gap, along, square = torch.tensor(0.3), torch.tensor([[0.4, 0.0, 0.0]]), torch.tensor([[0.25, 0.0, 0.0]])
    whole = 0.3 + 0.25
    expected = 0.5 * (whole - (whole**2 - 4 * 0.3 * 0.4**2) ** 0.5)
    assert float(eigenvalue_gain(along, square, gap)) == pytest.approx(expected, rel=1e-6)


def test_one_mode_is_told_by_the_particle_that_moves_most():
    U = orthonormal(torch.rand(20, 3, 1, dtype=torch.float64, generator=torch.Generator().manual_seed(0)))
    order = U.square().sum((1, 2)).argsort(descending=True).tolist()
    chosen = pivots(U, 5)
    assert chosen == order[:1]
    assert [*chosen, *oversampled(U, chosen, 5)] == order[:5]


def test_a_smaller_sample_is_a_part_of_a_larger(tiny_manifold):
    few, many = (QdeimSampler(n, modes=MODES).spans_of(tiny_manifold)[0].particles for n in (5, 40))
    assert len(set(many)) == 40
    assert set(few) < set(many)


def test_it_keeps_to_its_region(tiny_manifold):
    X = tiny_manifold.X.numpy()
    middle = float(np.median(X[:, 0]))
    sampler = QdeimSampler(9, lower=[middle, 0.0, 0.0], phases=[{"start": 0.5, "size": 4}])
    first, later = sampler.spans_of(tiny_manifold)
    assert (X[first.particles][:, 0] >= middle).all()
    assert len(later.particles) == 4


@pytest.mark.parametrize("modes", [0, 2.5])
def test_it_refuses(modes):
    with pytest.raises(ConfigError, match=rf"sampler\.modes={modes} must be a whole number"):
        QdeimSampler(10, modes=modes)
