"""States of colliders, as a recurrence takes them."""

import numpy as np

from nsf.mpm import Cuboid, HalfSpace, Motion
from nsf.recurrence import collider_states, principal


def plates():
    """Two that mirror each other, come to a halt and go, and a floor."""

    def motion(way):
        return Motion((0.0, 0.04), ((0.0, 0.0, 0.0), (0.0, 0.0, way)))

    return [
        Cuboid((0.5, 0.5, 0.2), (0.1, 0.1, 0.1), motion=motion(0.1), until=0.06),
        Cuboid((0.5, 0.5, 0.8), (0.1, 0.1, 0.1), motion=motion(-0.1), until=0.06),
        HalfSpace((0.0, 0.0, 0.1), (0.0, 0.0, 1.0)),
    ]


def test_the_state_of_colliders():
    states = collider_states(plates(), 0.01, 8)
    assert states.shape == (8, 27)
    np.testing.assert_allclose(states[:, 2], [0.0, 0.025, 0.05, 0.075, 0.1, 0.1, 0.1, 0.1])
    np.testing.assert_allclose(states[:, 11], -states[:, 2])
    np.testing.assert_allclose(states[:, 6], [0.025] * 4 + [0.0] * 4, atol=1e-15)
    np.testing.assert_array_equal(states[:, 8], [1] * 6 + [0] * 2)
    np.testing.assert_array_equal(states[:, 18:26], 0.0)


def test_what_moves_together_is_one_state_and_what_rests_is_none():
    mean, matrix = principal([collider_states(plates(), 0.01, 8)] * 2)
    c = (collider_states(plates(), 0.01, 8) - mean) @ matrix
    assert c.shape == (8, 3)  # way, speed and presence
    np.testing.assert_allclose(c[:, 0].std(), 1.0)
    assert len(np.unique(c.round(9), axis=0)) == 6  # the time itself is not told: what rests is alike
    _, none = principal([collider_states(plates()[2:], 0.01, 8)])
    assert none.shape == (9, 0)


def test_a_constant_speed_is_no_state():
    """The way of each step differs by round-off, which must not be taken for a state of its own."""
    motion = Motion([0.0, 0.6], [[0.0, 0.0, 0.0], [0.08, 0.0, 0.0]])
    grip = Cuboid([0.2, 0.5, 0.5], [0.1, 0.2, 0.2], "sticky", motion=motion)
    states = collider_states([grip], 0.004, 150)
    assert 0.0 < np.ptp(states[:, 4]) < 1e-15
    mean, matrix = principal([states])
    c = (states - mean) @ matrix
    assert c.shape == (150, 1)
    np.testing.assert_allclose(np.diff(c[:, 0], axis=0), c[1, 0] - c[0, 0], rtol=1e-9)
