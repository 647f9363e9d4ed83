"""Scenes that cannot be meant are refused; contact that is meant is not."""

import numpy as np
import pytest

from nsf import load_scene
from nsf.errors import ConfigError
from nsf.mpm import Cuboid, HalfSpace, Motion, Sphere
from nsf.scenes.checks import check_physics
from nsf.vectors import rotation

FEW = "scene.bodies.column.particles=300"
BASE = "scene.bodies.column.shape.base"


def body(shape):
    return f"+scene.bodies.other={{_target_: nsf.scenes.Body, shape: {shape}, particles: 200, density: 200}}"


def box(lower, upper):
    return body(f"{{_target_: nsf.scenes.Box, lower: {lower}, upper: {upper}}}")


def solid(text, kind="separate"):
    return f"+scene.colliders.block={{kind: {kind}, {text}}}"


BALL = "_target_: nsf.mpm.Sphere, radius: 0.2"
PLATE = "_target_: nsf.mpm.Cuboid, size: [0.3, 0.3, 0.1]"
DOWN = "motion: {_target_: nsf.mpm.Motion, times: [0, 0.4], translations: [[0, 0, %s], [0, 0, 0]]}"

REFUSED = {
    "overlapping bodies": (
        [box([0.5, 0.5, 0.13], [0.7, 0.7, 0.3])],
        r"scene\.bodies\.column overlaps scene\.bodies\.other: \d+ of its 300 particles",
    ),
    "a body in another": (
        [box([0.48, 0.48, 0.18], [0.52, 0.52, 0.22])],
        r"scene\.bodies\.\w+ overlaps scene\.bodies\.\w+: \d+ of its \d+ particles",
    ),
    "on a floor that it sinks into": (
        [f"{BASE}=[0.5, 0.5, 0.1]", "scene.colliders.floor.kind=separate"],
        r"column: \d+ of its 300 particles lie inside scene\.colliders\.floor \(kind=separate\) at t = 0, "
        r"up to 0\.0\d+ m deep; move one of them, or set kind=sticky",
    ),
    "under the floor": (["scene.colliders.floor.point=[0, 0, 0.3]"], r"\(kind=sticky\).*; move one of them$"),
    "in a ball": ([solid(BALL + ", centre: [0.5, 0.5, 0.2]", "slip")], r"inside scene\.colliders\.block"),
    "in a plate": ([solid(PLATE + ", centre: [0.5, 0.5, 0.3]")], r"inside scene\.colliders\.block"),
    "in a plate that begins there": (
        [solid(PLATE + f", centre: [0.5, 0.5, 0.6], {DOWN % -0.3}")],
        r"inside scene\.colliders\.block",
    ),
    "a floor below the domain": (
        ["scene.colliders.floor.point=[0, 0, -0.1]"],
        "floor lies outside the domain",
    ),
    "a floor above the domain": (
        ["scene.colliders.floor.point=[0, 0, 2]", "scene.colliders.floor.normal=[0, 0, -1]"],
        "floor lies outside the domain",
    ),
    "a ball beside the domain": (
        [solid(BALL + ", centre: [1.5, 0.5, 0.5]")],
        "block lies outside the domain",
    ),
    "walls that meet": (
        ["scene.walls.padding=33"],
        r"padding=33 from both sides leaves none of 65 nodes free",
    ),
    "a body in the walls": (["scene.walls.padding=20"], r"column lies wholly in scene\.walls\.padding=20"),
    "no time": (
        ["scene.dt=1e-300"],
        r"scene\.dt=1e-300 s an elastic wave of 3\.33 m/s crosses 2\.1e-296 of a cell",
    ),
    "no stiffness": (["material.E=1e-30"], r"crosses 1\.9e-15 of a cell: .*material\.E=1e-30 Pa"),
    "no lightness": (["scene.bodies.column.density=1e300"], "or lower the density"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_refused(case):
    overrides, quoted = REFUSED[case]
    with pytest.raises(ConfigError, match=quoted):
        load_scene("sand", [FEW, *overrides]).full_order(device="cpu")


MEANT = {
    "bodies that touch": [box([0.4, 0.4, 0.261465], [0.6, 0.6, 0.4])],
    "bodies that touch within a fraction of a cell": [box([0.4, 0.4, 0.26], [0.6, 0.6, 0.4])],
    "a root in a sticky floor": [f"{BASE}=[0.5, 0.5, 0.1]"],
    "on the floor within a fraction of a cell": [
        f"{BASE}=[0.5, 0.5, 0.128]",
        "scene.colliders.floor.kind=slip",
    ],
    "a plate that comes down later": [solid(PLATE + f", centre: [0.5, 0.5, 0.3], {DOWN % 0.3}")],
    "a plate that acts later": [solid(PLATE + ", centre: [0.5, 0.5, 0.3], since: 0.2")],
    "a ball that comes in": [solid(BALL + f", centre: [0.5, 0.5, 0.7], {DOWN % 1.5}")],
    "a grip": [solid(PLATE + ", centre: [0.5, 0.5, 0.3]", "sticky")],
    "no gravity": ["scene.gravity=[0, 0, 0]"],
    "one step": ["scene.steps=1", "scene.dt=1e-6"],
}


@pytest.mark.parametrize("case", MEANT)
def test_meant(case):
    check_physics(load_scene("sand", [FEW, *MEANT[case]]))


class TestDistance:
    def test_cuboid(self):
        block = Cuboid((1.0, 2.0, 3.0), (2.0, 4.0, 6.0), axis=(0.0, 0.0, 1.0), angle=90.0)
        x = np.array([[1.0, 2.0, 3.0], [2.5, 2.0, 3.0], [3.5, 2.0, 3.0], [1.0, 3.5, 3.0], [4.0, 4.0, 8.0]])
        np.testing.assert_allclose(block.distance(x), [-1.0, -0.5, 0.5, 0.5, 6.0**0.5], atol=1e-12)

    def test_half_space_and_sphere(self):
        x = np.array([[0.0, 0.0, 3.0], [0.0, 0.0, -1.0]])
        np.testing.assert_allclose(HalfSpace((5.0, 5.0, 1.0), (0.0, 0.0, 2.0)).distance(x), [2.0, -2.0])
        np.testing.assert_allclose(Sphere((0.0, 0.0, 0.0), 1.5).distance(x), [1.5, -0.5])

    def test_at_a_time(self):
        """As far from the moved solid as the point, moved back, is from the solid at rest."""
        motion = Motion((0.0, 1.0), ((0, 0, 0), (1, 2, 3)), (10.0, 50.0), (1.0, 1.0, 0.0), (0.2, 0.1, 0.0))
        block = Cuboid((0.5, 0.5, 0.5), (0.2, 0.4, 0.6), motion=motion)
        at_rest = np.random.default_rng(0).random((50, 3))
        turn = rotation(np.array([1.0, 1.0, 0.0]) / 2**0.5, 30.0)
        moved = (at_rest - [0.2, 0.1, 0.0]) @ turn.T + [0.7, 1.1, 1.5]
        np.testing.assert_allclose(
            block.distance(moved, 0.5), Cuboid((0.5, 0.5, 0.5), (0.2, 0.4, 0.6)).distance(at_rest), atol=1e-12
        )
