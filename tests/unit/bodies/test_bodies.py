"""Strips, grids and films: rows, titles, cuts, and files of bounded size."""

from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from nsf import bodies
from nsf.bodies import Body, Categories, ColorScale
from nsf.bodies.camera import Camera
from nsf.bodies.pictures import Stage
from nsf.scenes import Box

SCALE = ColorScale.up_to(2e3, "viridis", ((1e3, "kPa"), (1.0, "Pa")), title="stress")
T = np.array([0.0, 0.1, 0.2])


def fallen(particles: int = 300, extent=(1.0, 1.0, 1.0), **more) -> Body:
    X = Box((0.0, 0.0, 0.0), extent).sample(particles)
    x = np.stack([X, X * (1.0, 1.0, 0.8), X * (1.2, 1.2, 0.6)])
    return Body(x, 2e3 * x[..., 0], SCALE, **more)


def shown(figure) -> list[np.ndarray]:
    return [np.asarray(panel.images[0].get_array()) for panel in figure.axes if panel.images]


def told(figure) -> list[str]:
    return [text.get_text() for text in figure.texts]


def test_a_strip_has_a_row_a_body_and_the_first_and_last_frame():
    figure = bodies.strip([fallen(name="one"), fallen(name="two", warning="diverged")], T, count=2)
    assert {"t = 0 s", "t = 0.2 s", "one", "two", "diverged"} <= set(told(figure))
    pictures = shown(figure)
    assert len(pictures) == 4
    assert not np.array_equal(pictures[0], pictures[1])
    np.testing.assert_array_equal(pictures[0], pictures[2])
    assert any(panel.get_xlabel() == "stress [kPa]" for panel in figure.axes)


def test_a_grid_has_a_scale_a_column():
    other = ColorScale.up_to(1.0, "magma", ((1.0, "m"),), title="distance")
    body = fallen()
    figure = bodies.grid([[body, body, replace(body, scale=other)]] * 2, ("a", "b", "c"))
    assert len(shown(figure)) == 6
    assert {panel.get_xlabel() for panel in figure.axes} >= {"stress [kPa]", "distance [m]"}


def test_a_thick_body_is_cut_behind_its_middle_and_a_thin_one_is_whole():
    for extent, whole in (((1.0, 1.0, 1.0), False), ((1.0, 0.1, 1.0), True)):
        body = fallen(2000, extent)
        X = body.x[0]
        assert bodies.is_cut_open(X) is not whole
        front = (X - X.mean(0)) @ (Camera.facing(X).axes[2] * (1.0, 1.0, 0.0)) > 0.0
        dark = replace(body, values=np.where(front, 0.0, body.values))
        one, other = (shown(bodies.grid([[own]], ("",), cut=True))[0] for own in (body, dark))
        assert (one != other).any() == whole


def test_values_inside_a_body_are_told_from_those_at_its_surface():
    X = fallen(4000).x[0]
    inside = (np.abs(X - X.mean(axis=0)) < 0.3).all(axis=1)
    assert bodies.hides_inside(X, X, np.where(inside, 10.0, 0.1))
    assert not bodies.hides_inside(X, X, np.ones(len(X)))


def test_points_of_a_category_are_seen_through_the_others():
    body = fallen(2000)
    middle = np.linalg.norm(body.x[0] - 0.5, axis=1).argmin()
    values = np.zeros(body.values.shape, int)
    values[:, middle] = 1
    scale = Categories({"others": "#bbbbbb", "one": "#ff0000"})
    for through, seen in (({}, False), ({1: 1.0}, True)):
        own = replace(body, values=values, scale=scale, through=through)
        stage = Stage([own])
        picture = stage.picture(stage.view(80), own, 0).astype(int)
        assert (picture[..., 0] > picture[..., 1] + 80).any() == seen


def test_every_point_of_many_may_be_drawn():
    body = fallen(200_000)
    stage = Stage([body])
    picture = stage.picture(stage.view(200), body, 0)
    assert (picture < 250).any(axis=2).mean() > 0.3


def test_a_film_is_no_larger_than_it_may_be(tmp_path):
    images = list(bodies.frames([[fallen()]], T, ("reduced",), size=400))
    assert len(images) == 3
    bodies.film(images, tmp_path / "large.gif")
    bodies.film(images, tmp_path / "small.gif", most=8000)
    large, small = (tmp_path / name for name in ("large.gif", "small.gif"))
    assert small.stat().st_size <= 8000 < large.stat().st_size
    with Image.open(large) as film:
        assert film.n_frames == 3
        assert film.convert("RGB").getpixel((2, 2)) == (255, 255, 255)


def test_a_film_of_odd_sides_is_an_mp4(tmp_path):
    imageio = pytest.importorskip("imageio.v2")
    pytest.importorskip("imageio_ffmpeg")
    images = [Image.new("RGB", (161, 121), (80 * k, 0, 0)) for k in range(3)]
    bodies.film(images, tmp_path / "a.mp4", fps=10)
    with imageio.get_reader(tmp_path / "a.mp4") as film:
        assert film.count_frames() == 3
        assert film.get_data(2).shape == (120, 160, 3)
