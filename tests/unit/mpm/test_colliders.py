"""Colliders: what the grid and the step are too coarse for, poses at rest, bounds on speed."""

import re

import numpy as np
import pytest

from nsf.errors import ConfigError, InstabilityError
from nsf.mpm import FP64, BoundaryArrays, Cuboid, DomainWalls, HalfSpace, Motion, Sphere, floor_height

DX = 1.0 / 16.0
ORIGIN, UP, MIDDLE = (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.5, 0.5, 0.5)


def rushing(speed):
    return Motion((0.0, 0.5, 1.0), (ORIGIN, (0.0, 0.3, 0.0), (0.0, 0.3, 0.5 * speed)))


def spinning(degrees, pivot):
    return Motion((0.0, 1.0), angles=(0.0, degrees), axis=(1.0, 0.0, 0.0), pivot=pivot)


@pytest.mark.parametrize(
    ("collider", "speed"),
    [
        (HalfSpace(MIDDLE, UP, motion=rushing(40.0)), 40.0),
        (Sphere(MIDDLE, 0.2, motion=rushing(40.0)), 40.0),
        (Cuboid(MIDDLE, (0.2, 0.2, 0.2), motion=rushing(40.0)), 40.0),
        # Half a diagonal from the pivot; a ball's far side; from a corner of the domain to the other.
        (Cuboid(MIDDLE, (0.6, 0.8, 1e-9), motion=spinning(3600.0, MIDDLE)), 20.0 * np.pi * 0.5),
        (Sphere(MIDDLE, 0.2, motion=spinning(3600.0, (0.5, 0.2, 0.5))), 20.0 * np.pi * 0.5),
        (HalfSpace(MIDDLE, UP, motion=spinning(3600.0, ORIGIN)), 20.0 * np.pi * 3.0**0.5),
    ],
)
def test_a_collider_that_crosses_a_cell_in_a_step_is_refused(collider, speed, block, solver_of):
    floor = HalfSpace((0.0, 0.0, 0.1), UP)
    with pytest.raises(InstabilityError, match=r"collider 1 \(.*\) moves at up to") as refusal:
        solver_of(block, dt=0.01, colliders=[floor, collider])
    largest = float(re.search(r"largest stable dt is (\S+) s", str(refusal.value)).group(1))
    assert largest == pytest.approx(DX / speed, rel=1e-4)
    assert f"{speed:.6g} m/s" in str(refusal.value)
    solver_of(block, dt=largest, colliders=[floor, collider])


@pytest.mark.parametrize(
    ("coarse", "fine"),
    [
        (Sphere(MIDDLE, 1.4 * DX), Sphere(MIDDLE, 1.5 * DX)),
        (Cuboid(MIDDLE, (0.5, 2.9 * DX, 0.5), "separate"), Cuboid(MIDDLE, (0.5, 3.0 * DX, 0.5), "separate")),
        (Cuboid(MIDDLE, (0.5, 0.1 * DX, 0.5), "separate"), Cuboid(MIDDLE, (0.5, 0.1 * DX, 0.5), "slip")),
    ],
)
def test_a_shape_that_the_grid_does_not_hold_is_refused(coarse, fine, block, solver_of):
    with pytest.raises(ConfigError, match=r"collider 0 \(.*\) needs dx of at most \S+ m, not 0.0625 m"):
        solver_of(block, colliders=[coarse])
    solver_of(block, colliders=[fine])


def test_poses_at_rest():
    tilted = Cuboid((0.1, 0.2, 0.3), (0.2, 0.4, 0.6), axis=(0.0, 0.0, 5.0), angle=90.0)
    colliders = [HalfSpace(MIDDLE, (0.0, 0.0, 2.0)), Sphere(MIDDLE, 0.2), tilted]
    arrays = BoundaryArrays(colliders, DomainWalls(), FP64, "cpu")
    np.testing.assert_array_equal(arrays.position.numpy(), [MIDDLE, MIDDLE, (0.1, 0.2, 0.3)])
    np.testing.assert_allclose(arrays.extents.numpy(), [UP, (0.2, 0.0, 0.0), (0.1, 0.2, 0.3)])
    np.testing.assert_allclose(
        arrays.orientation.numpy(),
        [np.eye(3), np.eye(3), [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]],
        atol=1e-15,
    )
    assert (arrays.active.numpy() == 1).all()


@pytest.mark.parametrize("precision", ["fp64", "fp32"])
def test_time_goes_on_in_either_precision(precision, block, solver_of):
    """The solver's and the colliders' time are one, however many steps are taken."""
    lift = Motion((0.0, 10.0), (ORIGIN, (0.0, 0.0, 0.3)))
    solver = solver_of(block, colliders=[Cuboid(MIDDLE, (0.4, 0.4, 0.4), motion=lift)], precision=precision)
    solver.step(500)
    boundaries = solver.grid_step.forcing.boundaries
    assert boundaries.steps.numpy().tolist() == [500]
    # The pose is that of the last step's start.
    height = 0.5 + 0.03 * 499 * solver.dt
    assert boundaries.position.numpy()[0, 2] == pytest.approx(
        height, abs=1e-12 if precision == "fp64" else 1e-7
    )
    rise = solver.state.x.numpy()[:, 2] - block[:, 2]
    np.testing.assert_allclose(rise, 0.03 * solver.time, atol=1e-12 if precision == "fp64" else 2e-5)


def test_no_step_is_counted_where_nothing_moves(block, solver_of):
    solver = solver_of(block, colliders=[HalfSpace((0.0, 0.0, 0.1), UP)])
    solver.step(3)
    assert solver.grid_step.forcing.boundaries.steps.numpy().tolist() == [0]


@pytest.mark.parametrize(
    ("colliders", "height"),
    [
        ((HalfSpace(MIDDLE, (0.0, 0.0, 2.0)),), 0.5),
        ((Sphere(MIDDLE, 0.1), Cuboid(MIDDLE, (0.4, 0.4, 0.4)), HalfSpace(MIDDLE, UP)), 0.5),
        ((HalfSpace(MIDDLE, (0.0, 0.1, 1.0)),), None),
        ((HalfSpace(MIDDLE, UP, motion=rushing(1.0)),), None),
        ((Sphere(MIDDLE, 0.1),), None),
        ((), None),
    ],
)
def test_a_floor_is_a_horizontal_plane_at_rest(colliders, height):
    assert floor_height(colliders) == height
