"""What an evaluate run tells the reports about its scene."""

from dataclasses import replace

import pytest

from nsf.mpm import Cuboid, HalfSpace, Motion, Sphere
from nsf.pipeline.results import _floor
from nsf.scenes import load

MIDDLE, UP = (0.5, 0.5, 0.2), (0.0, 0.0, 2.0)
SINKING = Motion((0.0, 1.0), ((0.0, 0.0, 0.0), (0.0, 0.0, -0.1)))


@pytest.mark.parametrize(
    ("colliders", "height"),
    [
        ((HalfSpace(MIDDLE, UP),), 0.2),
        ((Sphere(MIDDLE, 0.1), Cuboid(MIDDLE, UP[2:] * 3), HalfSpace(MIDDLE, UP)), 0.2),
        ((HalfSpace(MIDDLE, (0.0, 0.1, 1.0)),), None),
        ((HalfSpace(MIDDLE, UP, motion=SINKING),), None),
        ((Sphere(MIDDLE, 0.1),), None),
        ((), None),
    ],
)
def test_a_floor_is_a_horizontal_plane_at_rest(colliders, height):
    assert _floor(replace(load("sand"), colliders=colliders)) == height
