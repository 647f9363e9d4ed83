"""Forcing between steps: gravity's keyframes, and what a hand sets, against closed forms."""

import numpy as np
import pytest

from nsf.errors import ConfigError
from nsf.mpm import Cuboid, Gravity, HalfSpace, Motion

DT = 0.002
RAMP = Gravity((0.01, 0.03, 0.05), ((0.0, 0.0, 0.0), (0.6, -0.3, 0.9), (0.6, 0.0, -0.6)))
LIFT = Motion((0.0, 0.1), ((0.0, 0.0, 0.0), (0.0, 0.0, 0.05)))


def solid(motion=None):
    return Cuboid((0.5, 0.5, 0.2), (0.3, 0.3, 0.2), "sticky", motion=motion)


def velocity(solver):
    return solver.state.numpy()["v"].mean(0)


@pytest.mark.parametrize("precision", ["fp64", "fp32"])
def test_a_free_body_gains_what_gravity_gives_at_the_start_of_each_step(solver_of, block, precision):
    solver = solver_of(block, DT, gravity=RAMP, precision=precision)
    solver.step(30)
    expected = DT * RAMP.at(DT * np.arange(30)).sum(0)
    tolerance = 1e-12 if precision == "fp64" else 1e-6
    np.testing.assert_allclose(velocity(solver), expected, atol=tolerance)
    assert np.abs(expected).max() > 0.01


@pytest.mark.parametrize("gravity", [RAMP, (0.0, 0.0, -0.5)], ids=["program", "constant"])
def test_a_hand_holds_from_the_next_step_on_and_a_restart_gives_it_back(solver_of, block, gravity):
    solver = solver_of(block, DT, gravity=gravity)
    before = gravity.at(DT * np.arange(20)) if gravity is RAMP else np.tile(gravity, (20, 1))
    solver.step(20)
    solver.forcing.gravity = (0.0, 0.7, 0.0)
    np.testing.assert_array_equal(solver.forcing.gravity, (0.0, 0.7, 0.0))
    solver.step(10)
    np.testing.assert_allclose(velocity(solver), DT * before.sum(0) + [0.0, 7.0 * DT, 0.0], atol=1e-12)
    solver.restart()
    solver.step(20)
    np.testing.assert_allclose(velocity(solver), DT * before.sum(0), atol=1e-12)


def test_a_released_program_goes_on_where_it_would_be(solver_of, block):
    solver = solver_of(block, DT, gravity=RAMP)
    solver.forcing.gravity = (0.0, 0.0, 0.0)
    solver.step(12)
    solver.forcing.release()
    solver.step(1)
    np.testing.assert_allclose(velocity(solver), DT * RAMP.at(DT * 12), atol=1e-13)


def test_a_solid_goes_on_from_where_it_is(solver_of, block):
    solver = solver_of(block, DT, colliders=[solid(), solid(LIFT)], names=["table", "lift"])
    boundaries = solver.grid_step.forcing.boundaries
    solver.step(10)
    solver.forcing.move("lift", (0.1, 0.0, -0.2))
    solver.step(6)  # the pose on the device is that of the last step's start
    expected = [0.5, 0.5, 0.2 + 10 * DT * 0.5] + 5 * DT * np.array([0.1, 0.0, -0.2])
    np.testing.assert_allclose(boundaries.position.numpy()[1], expected, atol=1e-10)
    np.testing.assert_allclose(boundaries.velocity.numpy()[1], [0.1, 0.0, -0.2], atol=1e-9)
    np.testing.assert_allclose(boundaries.position.numpy()[0], [0.5, 0.5, 0.2], atol=0)
    solver.restart()
    solver.step(11)
    np.testing.assert_allclose(boundaries.position.numpy()[1], [0.5, 0.5, 0.2 + 10 * DT * 0.5], atol=1e-14)


def test_a_solid_spins_about_its_own_axis(solver_of, block):
    turn = Motion((0.0, 0.1), angles=(0.0, 9.0), axis=(0.0, 0.0, 1.0), pivot=(0.5, 0.5, 0.2))
    solver = solver_of(block, DT, colliders=[solid(turn)], names=["mill"])
    solver.step(10)
    solver.forcing.move("mill", spin=-45.0)
    solver.step(11)
    angle = np.radians(10 * DT * 90.0 - 10 * DT * 45.0)
    expected = [[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]]
    found = solver.grid_step.forcing.boundaries.orientation.numpy()[0]
    np.testing.assert_allclose(found, expected, atol=1e-9)


@pytest.mark.parametrize(
    ("do", "message"),
    [
        (lambda f: setattr(f, "gravity", (0.0, np.nan, 0.0)), "forcing.gravity.* must be"),
        (lambda f: setattr(f, "gravity", 9.81), "forcing.gravity"),
        (lambda f: f.move("blade", (0, 0, 1)), "no collider 'blade'; there are: floor, lift"),
        (lambda f: f.move("floor", (0, 0, 1)), "'floor' stands still in its scene; give it a motion"),
        (lambda f: f.move("lift", (0, 0, np.inf)), "velocity"),
        (lambda f: f.move("lift", spin=3.0), "the solid's own motion has no axis"),
    ],
)
def test_what_a_hand_may_not_set(solver_of, block, do, message):
    floor = HalfSpace((0.0, 0.0, 0.1), (0.0, 0.0, 1.0))
    solver = solver_of(block, DT, colliders=[floor, solid(LIFT)], names=["floor", "lift"])
    with pytest.raises(ConfigError, match=message):
        do(solver.forcing)
    solver.step(2)
    np.testing.assert_allclose(velocity(solver), 0.0, atol=1e-15)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Gravity((0.0, 0.0), ((0, 0, 1), (0, 0, 2))), "must be at least one and ascend"),
        (lambda: Gravity((), ()), "must be at least one"),
        (lambda: Gravity((0.0,), ((0, np.inf, 1),)), "gravity.values"),
    ],
)
def test_keyframes_that_are_refused(make, message):
    with pytest.raises(ConfigError, match=message):
        make()
