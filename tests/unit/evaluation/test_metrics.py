"""Metrics against values worked out by hand."""

import math

import numpy as np
import pytest
import torch

from nsf.errors import ShapeError
from nsf.evaluation import deformation_error, displacement_error, metrics, stress_error


def tensor(values):
    return torch.tensor(values, dtype=torch.float64)


@pytest.fixture
def X():
    return tensor([[0.0, 0.0, 1.0], [0.0, 2.0, 0.0]])


@pytest.fixture
def x_fom(X):
    """Two frames; all displacements are along x, of 1 and 2, then of 3 and 4."""
    return torch.stack([X + tensor([[1.0, 0, 0], [2.0, 0, 0]]), X + tensor([[3.0, 0, 0], [4.0, 0, 0]])])


@pytest.fixture
def x_rom(x_fom):
    """Off by 0.3 at one particle in one frame and by 0.4 at another in the other."""
    x = x_fom.clone()
    x[0, 1, 2] += 0.3
    x[1, 0, 1] -= 0.4
    return x


def test_deformation_error_by_hand(x_rom, x_fom):
    # ‖x_rom − x_fom‖² = 0.09 + 0.16; ‖x_fom‖² = (1+1) + (4+4) + (9+1) + (16+4) = 40
    assert deformation_error(x_rom, x_fom) == pytest.approx(0.5 / math.sqrt(40.0), rel=1e-14)


def test_displacement_error_by_hand(x_rom, x_fom, X):
    # ‖x_fom − X‖² = 1 + 4 + 9 + 16
    assert displacement_error(x_rom, x_fom, X) == pytest.approx(0.5 / math.sqrt(30.0), rel=1e-14)


def test_a_shift_of_the_origin_changes_delta_and_not_the_displacement_error(x_rom, x_fom, X):
    """physics.md: the paper's δ is not translation invariant."""
    shift = 5.0
    before, after = deformation_error(x_rom, x_fom), deformation_error(x_rom + shift, x_fom + shift)
    assert after < 0.3 * before
    moved = displacement_error(x_rom + shift, x_fom + shift, X + shift)
    assert moved == pytest.approx(displacement_error(x_rom, x_fom, X), rel=1e-12)


def test_a_shift_in_the_unit_cube():
    """physics.md: shift the origin by 5 in each axis and a 1 % error reads 0.11 %."""
    x_fom = torch.rand(3, 2000, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    x_rom = 1.01 * x_fom
    assert deformation_error(x_rom, x_fom) == pytest.approx(0.01, rel=1e-12)
    assert deformation_error(x_rom + 5.0, x_fom + 5.0) == pytest.approx(0.00105, rel=0.02)


def test_stress_error_counts_off_diagonals_twice():
    """The Frobenius norm of the matrix: xy, xz and yz each stand for two entries."""
    for k, weight in enumerate((1, 2, 2, 1, 2, 1)):
        tau = torch.zeros(1, 1, 6, dtype=torch.float64)
        tau[0, 0, k] = 3.0
        assert metrics.tensor_squares(tau).tolist() == [9.0 * weight]
    full = tensor([[[1.0, 2.0, 3.0, 4.0, 5.0, 6.0]]])
    off = full.clone()
    off[0, 0, 1] += 0.1
    matrix = np.array([[1.0, 2, 3], [2, 4, 5], [3, 5, 6]])
    expected = np.linalg.norm([[0.0, 0.1], [0.1, 0.0]]) / np.linalg.norm(matrix)
    assert stress_error(off, full) == pytest.approx(expected, rel=1e-12)


def test_no_error_is_zero(x_fom, X):
    tau = torch.randn(2, 3, 6, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    assert deformation_error(x_fom, x_fom) == 0.0
    assert displacement_error(x_fom, x_fom, X) == 0.0
    assert stress_error(tau, tau) == 0.0


def test_single_precision_is_summed_in_double():
    x_fom = torch.full((1, 100_000, 3), 0.5)
    x_rom = x_fom + 2.0**-12
    assert deformation_error(x_rom, x_fom) == pytest.approx(2.0**-11, rel=1e-12)


@pytest.mark.parametrize("metric", [deformation_error, stress_error])
def test_shapes_must_agree(metric):
    with pytest.raises(ShapeError, match=r"\(2, 3, 3\) and \(2, 4, 3\)"):
        metric(torch.zeros(2, 3, 3), torch.zeros(2, 4, 3))
    with pytest.raises(ShapeError, match=r"trajectories differ"):
        displacement_error(torch.zeros(2, 3, 3), torch.zeros(1, 3, 3), torch.zeros(3, 3))


@pytest.mark.parametrize(
    ("tau", "expected"),
    [((3.0, 0, 0, 0, 0, 0), 3.0), ((0, 2.0, 0, 0, 0, 0), 2 * 3**0.5), ((-5.0, 0, 0, -5.0, 0, -5.0), 0.0)],
)
def test_von_mises_of_tension_shear_and_pressure(tau, expected):
    assert float(metrics.von_mises(tensor(tau))) == pytest.approx(expected, abs=1e-12)
