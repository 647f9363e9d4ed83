"""Colliders in pictures: where they stand, what they hide, and which way is up."""

from dataclasses import replace

import numpy as np
import pytest
from synthetic import Made, collapse

from nsf.reporting.bodies.camera import Camera, View
from nsf.reporting.bodies.shapes import Case, Stage
from nsf.reporting.bodies.solids import faces, reaches, upright
from nsf.reporting.sources import Motion

RED = np.array([1.0, 0.0, 0.0])
TOWARD = Camera().axes[2]


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


def motion(surroundings: dict) -> Motion:
    t = np.linspace(0.0, 0.6, 2)
    shown = collapse(Made(particles=200, frames=2), np.random.default_rng(0), 30.0, t)
    return Motion(30.0, "test", t, **shown, surroundings=surroundings)


def test_gravity_points_down_in_pictures():
    angle = np.radians(21.0)
    gravity = 9.81 * np.array([np.sin(angle), 0.0, -np.cos(angle)])
    inclined = motion(around(("half-space", (0, 0, 1), (0.0, 0.0, 0.13)), gravity=gravity))
    shown = upright(inclined)
    down = (inclined.x_full[0] + 0.01 * gravity / 9.81).astype(np.float32)
    fallen = upright(replace(inclined, x_reduced=down[None]))
    np.testing.assert_allclose(fallen.x_reduced[0] - shown.x_full[0], [[0, 0, -0.01]] * len(down), atol=1e-6)
    toward = Camera().axes[2]
    (top, *_) = [face for face in faces(shown, 0, toward, reaches([shown])) if face.ground]
    assert top.normal @ [0, 0, 1] == pytest.approx(np.cos(angle), abs=1e-6)
    level = motion(around())
    assert upright(level) is level


def test_an_upright_body_stays_as_it_is():
    inclined = motion(around(("half-space", (0, 0, 1), (0.0, 0.0, 0.13)), gravity=(3.0, 0.0, -9.0)))
    once = upright(inclined)
    np.testing.assert_allclose(upright(once).x_full, once.x_full, atol=1e-7)
    assert np.abs(once.x_full - inclined.x_full).max() > 0.01


def test_the_ground_hides_what_lies_beneath_it():
    for height, seen in ((0.05, True), (0.6, False)):
        shown = motion(around(("half-space", (0, 0, 1), (0.0, 0.0, height))))
        stage = Stage([Case(shown)])
        view = stage.view(80)
        picture = stage.picture(view, shown, 0, shown.x_full[0], np.tile(RED, (200, 1))).astype(int)
        reddish = picture[..., 0] > picture[..., 1] + 60
        assert reddish.any() == seen


def test_a_solid_lets_show_what_it_covers():
    x = motion({}).x_full[0]
    before = x.mean(axis=0) + 0.5 * TOWARD
    shown = motion(around(("cuboid", (0.1, 0.1, 0.1), tuple(before))))
    view = View.around(x, 80, Camera())
    bare, behind = (
        view.picture(x, np.tile(RED, (200, 1)), 0.03, faces(m, 0, TOWARD, reaches([m])))
        for m in (motion({}), shown)
    )
    changed = (bare.astype(int) - behind != 0).any(axis=2)
    assert 0.02 < changed.mean() < 0.9
    assert (behind[changed][:, 0].astype(int) > behind[changed][:, 1] + 20).any()  # still red
    gone = replace(shown, surroundings={**shown.surroundings, "solid_active": np.zeros((2, 1), bool)})
    assert not faces(gone, 0, TOWARD, reaches([gone]))


def test_a_wall_between_viewer_and_body_is_not_drawn():
    away = -TOWARD * (1.0, 1.0, 0.0)
    near = motion(around(("half-space", tuple(away / np.linalg.norm(away)), tuple(0.5 + TOWARD))))
    assert not faces(near, 0, TOWARD, reaches([near]))
    ball = motion(around(("sphere", (0.1, 0.0, 0.0), (0.5, 0.5, 0.5))))
    (disc,) = faces(ball, 0, TOWARD, reaches([ball]))
    np.testing.assert_allclose(np.linalg.norm(disc.corners - 0.5, axis=1), 0.1, rtol=1e-6)


def test_runs_that_kept_other_particles_are_each_cut_behind_the_middle():
    """The particles of pictures hold S, which differs from run to run."""
    first = motion({})
    order = np.random.default_rng(5).permutation(200)
    names = ("x_full", "x_reduced", "stress_full", "stress_reduced")
    other = replace(first, **{name: getattr(first, name)[:, order] for name in names})
    one, two = Stage([Case(first, baseline=other), Case(other)], cut=True).cases
    for cut in (one.motion, one.baseline, two.motion):
        behind = (cut.x_full[0] - first.x_full[0].mean(axis=0)) @ (TOWARD * (1.0, 1.0, 0.0))
        assert 20 < len(behind) < 180
        assert (behind <= 1e-6).all()
    for name in names:
        np.testing.assert_array_equal(
            np.sort(getattr(one.motion, name), axis=1), np.sort(getattr(two.motion, name), axis=1)
        )
