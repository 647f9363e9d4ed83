"""The spatula parts the cake at every angle (paper section 6.1)."""

import numpy as np
import pytest

import nsf
from nsf.vectors import direction, rotation


def cut(angle, overrides=()):
    """Opening of the halves across the blade, in its thicknesses, and the particles left in its way."""
    scene = nsf.load_scene("cake", ["scale=small", *overrides])
    solver = scene.full_order({"angle": angle}, device="cpu")
    solver.step(scene.steps)
    X, x = scene.particles().X, solver.state.numpy()["x"]
    blade = scene.solids[0]
    across = rotation(direction("axis", blade.motion.axis), angle) @ blade.orientation[:, 0]
    side, moved = (X - blade.motion.pivot) @ across, (x - X) @ across
    right, left = (side > 0.0) & (side < 0.1), (side < 0.0) & (side > -0.1)
    opening = np.median(moved[right]) - np.median(moved[left])
    at = (x - blade.motion.pivot) @ across - (-0.03)  # [m] by which the blade pushes sideways in the end
    # Its inner part; beneath it, the two lowest cells hold crumbs.
    in_the_way = (x[:, 2] > 0.13 + 2.0 * scene.dx) & (np.abs(at) < 0.2 * blade.size[0])
    return opening / blade.size[0], in_the_way.sum()


@pytest.mark.parametrize("angle", [0.0, 28.0])
def test_spatula_parts_the_cake(angle):
    opening, in_the_way = cut(angle)
    assert opening > 0.9
    assert in_the_way == 0


def test_cake_is_whole_without_the_spatula():
    opening, in_the_way = cut(14.0, ["scene.colliders.spatula.motion.translations=[[0,0,0],[0,0,0],[0,0,0]]"])
    assert abs(opening) < 1e-6
    assert in_the_way > 50
