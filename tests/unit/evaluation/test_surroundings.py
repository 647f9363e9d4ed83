"""Surroundings of a run are where its colliders are."""

import numpy as np
import pytest

from nsf import load_scene
from nsf.evaluation.surroundings import surroundings
from nsf.scenes import Scene


def scene(name: str) -> Scene:
    return load_scene(name, ["scale=small"])


@pytest.mark.parametrize("name", ["cake", "metal", "toothpaste"])
def test_corners_and_planes_lie_on_the_colliders(name):
    found = scene(name)
    t = np.linspace(0.0, found.dt * found.steps, 5)
    around = surroundings(found, t)
    for c, solid in enumerate(found.solids):
        assert around["solid_shape"][c] == solid.name
        for frame, time in enumerate(t):
            turn, extents = around["solid_orientation"][frame, c], around["solid_extents"][c]
            corner = around["solid_position"][frame, c] + (solid.name == "cuboid") * turn @ extents
            assert solid.distance(corner[None].astype(float), time).item() == pytest.approx(0.0, abs=1e-6)


def test_solids_that_are_gone_and_inclined_gravity():
    metal = surroundings(scene("metal"), np.array([0.0, 0.29, 0.3, 0.6]))
    assert metal["solid_active"].tolist() == [[True, True], [True, True], [False, False], [False, False]]
    paste = scene("toothpaste").at({"inclination": 21.0})
    gravity = surroundings(paste, np.zeros(1))["gravity"][0]
    assert np.degrees(np.arctan2(abs(gravity[0]), -gravity[2])) == pytest.approx(21.0, abs=1e-3)
