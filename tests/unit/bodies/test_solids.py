"""Colliders in pictures: where they stand, what they hide, and which way is up."""

import numpy as np
import pytest

from nsf.bodies import Body, ColorScale
from nsf.bodies.camera import Camera, View
from nsf.bodies.pictures import Stage
from nsf.bodies.solids import Solids, upright
from nsf.scenes import Box

RED = np.array([1.0, 0.0, 0.0])
TOWARD = Camera().axes[2]
SCALE = ColorScale(1.0, "autumn", 1.0, "Pa")
X = Box((0.3, 0.3, 0.13), (0.7, 0.7, 0.53)).sample(200)


def around(*solids: tuple[str, tuple, tuple], frames: int = 2, gravity=(0.0, 0.0, -9.81)) -> dict:
    """Surroundings of solids at rest, each by shape, extents and position."""
    shapes, extents, positions = zip(*solids, strict=True) if solids else ((), (), ())
    count = len(solids)
    return {
        "gravity": np.tile(np.array(gravity, np.float32), (frames, 1)),
        "solid_shape": np.array(shapes, str),
        "solid_extents": np.array(extents, np.float32).reshape(-1, 3),
        "solid_position": np.tile(np.array(positions, np.float32).reshape(-1, 3), (frames, 1, 1)),
        "solid_orientation": np.tile(np.eye(3, dtype=np.float32), (frames, count, 1, 1)),
        "solid_active": np.ones((frames, count), bool),
    }


def body(surroundings: dict, x: np.ndarray = X) -> Body:
    return Body(np.stack([x, x]), np.zeros((2, len(x))), SCALE, surroundings)


def solids(surroundings: dict, x: np.ndarray = X) -> Solids:
    found = Solids(surroundings, x.mean(axis=0))
    found.reached = found.reach([found.turned(x)])
    return found


def test_gravity_points_down_in_pictures():
    angle = np.radians(21.0)
    gravity = 9.81 * np.array([np.sin(angle), 0.0, -np.cos(angle)])
    inclined = solids(around(("half-space", (0, 0, 1), (0.0, 0.0, 0.13)), gravity=gravity))
    fallen = inclined.turned(X + 0.01 * gravity / 9.81) - inclined.turned(X)
    np.testing.assert_allclose(fallen, [[0, 0, -0.01]] * len(X), atol=1e-6)
    (top, *_) = [face for face in inclined.faces(0, TOWARD) if face.ground]
    assert top.normal @ [0, 0, 1] == pytest.approx(np.cos(angle), abs=1e-6)
    np.testing.assert_array_equal(upright(np.array([0.0, 0.0, -9.81])), np.eye(3))
    turn = upright(np.array([1.0, 2.0, 3.0]))
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-12)


def test_the_ground_hides_what_lies_beneath_it():
    fine = Box((0.3, 0.3, 0.13), (0.7, 0.7, 0.53)).sample(20_000)  # small balls lie within its sides
    for height, seen in ((0.05, True), (0.8, False)):
        shown = body(around(("half-space", (0, 0, 1), (0.0, 0.0, height))), fine)
        stage = Stage([shown])
        picture = stage.picture(stage.view(80), shown, 0).astype(int)
        assert ((picture[..., 0] > picture[..., 1] + 60).mean() > 0.01) == seen


def test_a_solid_lets_show_what_it_covers():
    before = around(("cuboid", (0.1, 0.1, 0.1), tuple(X.mean(axis=0) + 0.5 * TOWARD)))
    view, red = View.around(X, 80, Camera()), np.tile(RED, (200, 1))
    bare, behind = (view.picture(X, red, 0.03, own.faces(0, TOWARD)) for own in (solids({}), solids(before)))
    changed = (bare.astype(int) - behind != 0).any(axis=2)
    assert 0.02 < changed.mean() < 0.9
    assert (behind[changed][:, 0].astype(int) > behind[changed][:, 1] + 20).any()  # still red
    assert not solids({**before, "solid_active": np.zeros((2, 1), bool)}).faces(0, TOWARD)


def test_a_wall_between_viewer_and_body_is_not_drawn():
    away = -TOWARD * (1.0, 1.0, 0.0)
    wall = ("half-space", tuple(away / np.linalg.norm(away)), tuple(0.5 + TOWARD))
    assert not solids(around(wall)).faces(0, TOWARD)
    (disc,) = solids(around(("sphere", (0.1, 0.0, 0.0), (0.5, 0.5, 0.5)))).faces(0, TOWARD)
    np.testing.assert_allclose(np.linalg.norm(disc.corners - 0.5, axis=1), 0.1, rtol=1e-6)


def test_the_last_frame_has_the_colliders_of_its_time():
    still = around(("sphere", (0.1, 0.0, 0.0), (0.5, 0.5, 0.5)))
    still["solid_position"][1] += 0.2
    shown = body(still)
    stage = Stage([shown])
    one, last = (stage._faces(shown, k)[0].corners.mean(axis=0) for k in (0, -1))
    np.testing.assert_allclose(last - one, 0.2, atol=1e-6)
