"""What the camera sees of many particles."""

import numpy as np
import pytest

from nsf.bodies import camera
from nsf.bodies.camera import Camera, View
from nsf.scenes import Box

RED, BLUE = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0])


def test_the_foremost_particles_make_the_same_picture():
    x = Box((0.0, 0.0, 0.0), (1.0, 1.0, 1.0)).sample(40_000)
    x[7] = np.nan
    colors, radius = x.copy(), 0.62 * len(x) ** (-1 / 3)
    colors[7] = 0.0
    view = View.around(x, width=200)
    front = view.front(x, radius)
    assert 7 not in front
    assert len(front) < 0.5 * len(x)
    whole, seen = view.picture(x, colors, radius), view.picture(x[front], colors[front], radius)
    differs = (np.abs(whole.astype(int) - seen) > 8).any(axis=2)
    assert differs.mean() < 0.02
    fewer = view.picture(x[front[::3]], colors[front[::3]], radius)
    assert (np.abs(whole.astype(int) - fewer) > 8).any(axis=2).mean() > 0.1


def test_a_pixel_is_the_mean_of_its_samples(monkeypatch):
    rng = np.random.default_rng(0)
    x, colors = rng.uniform(-0.9, 0.9, (400, 3)), rng.random((400, 3))
    fine = View.around(x, width=80).picture(x, colors, 0.08).astype(float)  # one sample a pixel
    height = len(fine) // 2
    view = View.around(x, width=40)
    monkeypatch.setattr(camera, "_OVERSAMPLE", 2)
    mean = fine[: 2 * height].reshape(height, 2, 40, 2, 3).mean((1, 3))
    np.testing.assert_allclose(view.picture(x, colors, 0.08)[:height], mean, atol=1.0)


def test_large_balls_one_by_one_are_what_small_ones_are_at_once(monkeypatch):
    rng = np.random.default_rng(0)
    centre = np.column_stack([rng.uniform(-20, 140, 300), rng.uniform(-20, 100, 300), rng.normal(size=300)])
    found = []
    for most in (0, 100):
        monkeypatch.setattr(camera, "_LARGE", most)
        found.append(camera._balls(centre, 0.7, 10.0, (80, 120)))
    for one, other in zip(*found, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-6)
    depth, owner, normal = found[0]
    row, column = np.argwhere(owner >= 0)[50]
    near = np.hypot(*(np.round(centre[:, :2]) - (column, row)).T) <= 7.0
    assert near[owner[row, column]]
    assert depth[row, column] == pytest.approx(centre[near, 2].max(), abs=0.71)
    np.testing.assert_allclose(np.linalg.norm(normal[owner >= 0], axis=1), 1.0, atol=1e-6)


def test_the_nearer_particle_hides_the_farther():
    camera = Camera(azimuth=-90, elevation=0)  # looks along +y
    view = View(camera, np.array([-1.0, -1.0]), np.array([1.0, 1.0]), width=40)
    for x in ([[0, -0.5, 0], [0, 0.5, 0]], [[0, 0.5, 0], [0, -0.5, 0]]):
        colors = np.array([RED, BLUE]) if x[0][1] < 0 else np.array([BLUE, RED])
        middle = view.picture(np.array(x, float), colors, radius=0.3)[20, 20].astype(int)
        assert middle[0] > middle[2] + 80


def test_particles_right_of_the_middle_are_drawn_right():
    view = View(Camera(-90, 0), np.array([-1.0, -1.0]), np.array([1.0, 1.0]), width=40)
    picture = view.picture(np.array([[0.5, 0, 0.5]]), RED[None], radius=0.2).astype(int)
    rows, columns = np.nonzero(picture[..., 0] > picture[..., 2] + 50)
    assert rows.mean() == pytest.approx(10, abs=1.5)  # row 0 is the top
    assert columns.mean() == pytest.approx(30, abs=1.5)


def test_particles_that_are_not_finite_are_left_out():
    view = View(Camera(), np.array([-1.0, -1.0]), np.array([1.0, 1.0]), width=20)
    assert view.picture(np.full((3, 3), np.nan), np.zeros((3, 3)), 0.2).min() == 255
