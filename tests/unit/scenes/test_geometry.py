"""Shapes and their sampling."""

import numpy as np
import pytest

from nsf import load_scene
from nsf.errors import ConfigError
from nsf.scenes import Ball, Box, Cylinder, Frame, Lattice, QuarterCylinder, Ribbon, TentacleBall
from nsf.scenes.shapes import geometry

WAVE = [(0.2 + 0.6 * t, 0.5 + 0.06 * np.sin(9.0 * t), 0.4 + 0.1 * t * t) for t in np.linspace(0.0, 1.0, 40)]
ZIGZAG = [(0.2, 0.5, 0.5), (0.5, 0.5, 0.5), (0.5, 0.8, 0.5), (0.5, 0.7, 0.9)]

SHAPES = [
    pytest.param(Box((0.1, 0.2, 0.3), (0.5, 0.4, 0.9)), id="box"),
    pytest.param(Cylinder((0.5, 0.5, 0.13), 0.2, 0.3), id="cylinder"),
    pytest.param(Cylinder((0.5, 0.5, 0.13), 0.02, 0.4), id="thin cylinder"),
    pytest.param(QuarterCylinder((0.5, 0.5, 0.13), 0.2, 0.3), id="quarter cylinder"),
    pytest.param(Ball((0.5, 0.4, 0.3), 0.2), id="ball"),
    pytest.param(Frame((0.2, 0.4, 0.3), (0.8, 0.6, 0.7), 0.1), id="frame"),
    pytest.param(Ribbon(ZIGZAG, 0.06), id="bent ribbon"),
    pytest.param(Ribbon(WAVE, 0.05), id="smooth ribbon"),
    pytest.param(TentacleBall((0.5, 0.5, 0.5), 0.15, 40, 0.1, 0.02), id="tentacle ball"),
]


@pytest.mark.parametrize("shape", SHAPES)
class TestSampling:
    @pytest.mark.parametrize("count", [1, 5000])
    def test_count_and_inside(self, shape, count):
        x = shape.sample(count)
        assert x.shape == (count, 3)
        assert shape.contains(x).all()
        lower, upper = shape.bounds
        assert ((x >= lower) & (x <= upper)).all()

    def test_deterministic_and_distinct(self, shape):
        x = shape.sample(2000)
        assert np.array_equal(x, shape.sample(2000))
        assert len(np.unique(x, axis=0)) == 2000

    @pytest.mark.parametrize(("count", "start"), [(10, 0), (3, 6600)])
    def test_more_points_continue_the_sequence(self, shape, count, start):
        assert np.array_equal(shape.sample(count, start), shape.sample(start + count)[start:])

    def test_even(self, shape):
        """Counts of cells of 12 points scatter less than random ones would (by √12 = 3.5)."""
        count = 20000
        x = shape.sample(count)
        edge = (12.0 * shape.volume / count) ** (1.0 / 3.0)
        lower, upper = shape.bounds
        n = np.floor((upper - lower) / edge).astype(int)
        cells = np.floor((x - lower) / edge).astype(int)
        counts = np.bincount(
            np.ravel_multi_index(cells[(cells < n).all(1)].T, n), minlength=n.prod()
        ).reshape(n)
        # Cells whose corners all lie in the shape are full.
        corners = np.stack(np.meshgrid(*[np.arange(k + 1) for k in n], indexing="ij"), -1) * edge + lower
        held = shape.contains(corners.reshape(-1, 3)).reshape(n + 1)
        full = np.logical_and.reduce(
            [held[i:, j:, k:][: n[0], : n[1], : n[2]] for i, j, k in np.ndindex(2, 2, 2)]
        )
        assert full.sum() > 50
        assert counts[full].mean() == pytest.approx(12.0, rel=0.03)
        # A scatter found from few cells is itself uncertain, by 1/√(2 cells).
        assert counts[full].std() < 0.65 * 12.0**0.5 * (1.0 + (2.0 * full.sum()) ** -0.5)

    def test_no_two_points_close(self, shape):
        """The smallest gap is a good part of the lattice spacing; random points come 5 times closer."""
        count = 1500
        x = shape.sample(count)
        squared = ((x[:, None] - x[None]) ** 2).sum(-1) + np.eye(count)
        assert squared.min() ** 0.5 > 0.3 * (shape.volume / count) ** (1.0 / 3.0)

    def test_volume_against_counting(self, shape):
        lower, upper = shape.bounds
        n = 64
        axes = [lo + (hi - lo) * (np.arange(n) + 0.5) / n for lo, hi in zip(lower, upper, strict=True)]
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
        counted = shape.contains(grid).mean() * np.prod(upper - lower)
        assert shape.volume == pytest.approx(counted, rel=0.01)


def test_a_lattice_is_filled_first():
    """Its points are at the centres of cubes; more points go on evenly, fewer are spread without holes."""
    box = Lattice((0.1, 0.1, 0.1), (0.3, 0.2, 0.4), spacing=0.05)
    lattice, more, fewer = box.sample(48), box.sample(60), box.sample(20)
    assert np.allclose(np.unique(lattice[:, 0]), [0.125, 0.175, 0.225, 0.275])
    assert len(np.unique(lattice.round(9), axis=0)) == 48
    assert np.array_equal(more[:48], lattice)
    assert np.array_equal(box.sample(12, 48), more[48:])
    assert np.array_equal(fewer, Box(box.lower, box.upper).sample(20))
    with pytest.raises(ConfigError, match="lattice spacing"):
        Lattice((0.0, 0.0, 0.0), (1.0, 1.0, 1.0), spacing=0.0)


def test_no_points_are_refused():
    with pytest.raises(ConfigError, match="particles=0"):
        Ball((0.5, 0.4, 0.3), 0.2).sample(0)


class Hollow(Box):
    """Says more of itself than it holds."""

    def contains(self, x):
        return np.zeros(len(x), bool)


@pytest.mark.parametrize(
    "shape",
    [
        Cylinder((0.5, 0.5, 0.13), 1e-6, 0.131465),
        Box((0.0, 0.0, 0.0), (1e-5, 1e-5, 1.0)),
        Box((0.0, 0.0, 0.0), (1e-300, 1e-300, 1.0)),
        Hollow((0.0, 0.0, 0.0), (1.0, 1.0, 1.0)),
    ],
)
def test_points_that_would_take_minutes_to_find_are_refused(shape):
    with pytest.raises(ConfigError, match=r"particles=300 cannot be placed .* make it thicker"):
        shape.sample(300)


def test_a_hundred_times_the_particles_of_the_thinnest_scene_are_not():
    """The tries for super-resolution stay within the limit, by far."""
    ribbon = load_scene("toothpaste", ["scale=paper"]).bodies["ribbon"]
    edge = (ribbon.shape.bounds[1] - ribbon.shape.bounds[0]).max()
    assert 100 * ribbon.particles * edge**3 / ribbon.shape.volume < 0.5 * geometry._MOST_DRAWN


def test_thin_shapes_are_cut_from_the_cube_not_squeezed():
    """Squeezed, the sequence would leave cells of a thin shape empty."""
    cube, slab = Box((0.0, 0.0, 0.0), (1.0, 1.0, 1.0)), Box((0.0, 0.0, 0.0), (1.0, 0.1, 1.0))
    x = cube.sample(5000)
    x = x[slab.contains(x)]
    assert len(x) > 400
    np.testing.assert_array_equal(slab.sample(len(x)), x)


@pytest.mark.parametrize(
    ("build", "quoted"),
    [
        (lambda: Box((0.0, 0.0, 0.0), (1.0, 0.0, 1.0)), r"upper=\(1.0, 0.0, 1.0\)"),
        (lambda: Box((0.0, 0.0), (1.0, 1.0)), r"lower=\(0.0, 0.0\)"),
        (lambda: Box((0.0, 0.0, float("nan")), (1.0, 1.0, 1.0)), "nan"),
        (lambda: Box((0.0, 0.0, -float("inf")), (1.0, 1.0, 1.0)), r"lower=\(0.0, 0.0, -inf\)"),
        (lambda: Cylinder((float("nan"), 0.5, 0.13), 0.1, 0.1), r"base=\(nan, 0.5, 0.13\)"),
        (lambda: Cylinder(("a", "b", "c"), 0.1, 0.1), r"base=\('a', 'b', 'c'\)"),
        (lambda: Cylinder((0.5, 0.5, 0.1), 0.0, 1.0), "radius=0.0"),
        (lambda: Cylinder((0.5, 0.5, 0.1), 0.1, -1.0), "height=-1.0"),
        (lambda: Ball((0.5, 0.5, 0.5), 0.0), "ball radius=0.0"),
        (lambda: Frame((0.0, 0.0, 0.0), (1.0, 1.0, 1.0), 0.0), "frame thickness=0.0"),
        (lambda: Frame((0.0, 0.0, 0.0), (1.0, 1.0, 0.4), 0.2), "thickness=0.2 m closes the hole"),
        (lambda: Frame((0.0, 0.0, 0.0), (1.0, 1.0, 1.0), 0.1, "w"), "frame axis='w'"),
        (lambda: Ribbon([(0.0, 0.0, 0.0)], 0.1), "at least 2 points"),
        (lambda: Ribbon([(0.0, 0.0, 0.0), (1.0, 0.0)], 0.1), r"ribbon path point=\(1.0, 0.0\)"),
        (lambda: Ribbon([(0.0, 0.0, 0.0), (0.0, 0.0, 0.0)], 0.1), "twice in a row"),
        (lambda: Ribbon(ZIGZAG, 0.0), "ribbon radius=0.0"),
        (lambda: Ribbon(ZIGZAG, 1e-6), r"radius=1e-06 m is less than a 5000th of its path of 1\.01 m"),
        (lambda: TentacleBall((0.5, 0.5, 0.5), 0.1, 10**6, 0.1, 1e-6), "tentacles=1000000 are more"),
        (lambda: Ribbon(ZIGZAG, 0.2), r"radius=0.2 m is too large for the bends"),
        (lambda: Ribbon([(0, 0, 0), (1, 0, 0), (0, 0, 0)], 0.1), "too large for the bends"),
        (lambda: Ribbon([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0.5, 1, 0), (0.5, -1, 0)], 0.1), "of itself at"),
        (lambda: TentacleBall((0.5, 0.5, 0.5), 0.1, 0, 0.1, 0.01), "tentacles=0"),
        (lambda: TentacleBall((0.5, 0.5, 0.5), 0.1, 2.5, 0.1, 0.01), "tentacles=2.5"),
        (lambda: TentacleBall((0.5, 0.5, 0.5), 0.1, 9, 0.1, -0.01), "tentacle_radius=-0.01"),
        (lambda: TentacleBall((0.5, 0.5, 0.5), 0.1, 9, 0.005, 0.01), "length=0.005 m must be at least"),
        (lambda: TentacleBall((0.5, 0.5, 0.5), 0.1, 90, 0.1, 0.03), "90 tentacles of .* overlap"),
    ],
)
def test_refused(build, quoted):
    with pytest.raises(ConfigError, match=quoted):
        build()


def counted(shape, points=200_000):
    """Volume [m³] by random points, and its standard error."""
    lower, upper = shape.bounds
    hits = shape.contains(np.random.default_rng(0).uniform(lower, upper, (points, 3))).mean()
    return np.array([hits, (hits * (1.0 - hits) / points) ** 0.5]) * np.prod(upper - lower)


def test_frame_is_four_bars():
    frame = Frame((0.0, 0.0, 0.0), (3.0, 1.0, 2.0), 0.5, axis="y")
    assert frame.volume == pytest.approx(3.0 * 2.0 - 2.0 * 1.0)
    x = [
        (1.5, 0.5, 0.2),
        (1.5, 0.01, 1.0),
        (1.5, 0.99, 1.0),
        (0.2, 0.5, 1.0),
        (0.7, 0.5, 1.0),
        (0.2, 1.1, 1.0),
    ]
    assert frame.contains(np.array(x)).tolist() == [True, False, False, True, False, False]


@pytest.mark.parametrize("axis", ["x", "y", "z"])
def test_frame_hole_goes_along_its_axis(axis):
    through = np.full((50, 3), 0.5)
    through[:, "xyz".index(axis)] = np.linspace(0.0, 1.0, 50)
    for other in "xyz":
        held = Frame((0.0, 0.0, 0.0), (1.0, 1.0, 1.0), 0.2, other).contains(through)
        assert held.any() == (other != axis)


class TestRibbon:
    def test_straight(self):
        """A cylinder and two half balls."""
        r, L = 0.1, 0.7
        ribbon = Ribbon([(0.1, 0.5, 0.5), (0.3, 0.5, 0.5), (0.8, 0.5, 0.5)], r)
        assert ribbon.volume == pytest.approx(np.pi * r**2 * L + 4.0 / 3.0 * np.pi * r**3, rel=1e-12)
        np.testing.assert_allclose(ribbon.bounds, [(0.0, 0.4, 0.4), (0.9, 0.6, 0.6)])

    def test_fine_path_tends_to_a_tube(self):
        """A torus' quarter: the volume of a smooth tube is that of its length."""
        angle = np.linspace(0.0, 0.5 * np.pi, 400)
        path = [(0.5 * np.cos(a), 0.5 * np.sin(a), 0.5) for a in angle]
        tube = np.pi * 0.1**2 * 0.5 * 0.5 * np.pi + 4.0 / 3.0 * np.pi * 0.1**3
        assert Ribbon(path, 0.1).volume == pytest.approx(tube, rel=1e-5)

    @pytest.mark.parametrize("seed", range(4))
    def test_volume_of_any_path_that_is_accepted(self, seed):
        """Bends of all sizes, also tight ones: the closed form, or a refusal."""
        rng = np.random.default_rng(seed)
        wild = (0.2, 0.6, 1.2, 3.0)[seed % 4]
        ribbon = None
        while ribbon is None:
            path, along = [np.zeros(3)], rng.normal(size=3)
            for _ in range(rng.integers(3, 8)):
                along = along / np.linalg.norm(along) + wild * rng.normal(size=3)
                path.append(path[-1] + rng.uniform(0.5, 4.0) * along / np.linalg.norm(along))
            try:
                ribbon = Ribbon([p.tolist() for p in path], 1.0)
            except ConfigError:
                continue
        volume, error = counted(ribbon)
        assert abs(ribbon.volume - volume) < 4.0 * error

    def test_turning_back_at_just_twice_the_radius_is_accepted(self):
        """A hairpin of two right angles touches itself and does not overlap."""
        hairpin = Ribbon([(0.1, 0.2, 0.5), (0.8, 0.2, 0.5), (0.8, 0.4, 0.5), (0.1, 0.4, 0.5)], 0.1)
        volume, error = counted(hairpin)
        assert abs(hairpin.volume - volume) < 4.0 * error


class TestTentacleBall:
    @pytest.mark.parametrize(
        ("tentacles", "length", "thickness"),
        [(1, 0.2, 0.1), (60, 0.1, 0.012)],
    )
    def test_volume(self, tentacles, length, thickness):
        ball = TentacleBall((0.5, 0.5, 0.5), 0.12, tentacles, length, thickness)
        volume, error = counted(ball)
        assert abs(ball.volume - volume) < 4.0 * error

    def test_tentacles_are_evenly_spread(self):
        """They balance, and no two are nearer than 0.8 of the best hexagonal spacing."""
        d = TentacleBall((0.5, 0.5, 0.5), 0.1, 100, 0.1, 0.008)._directions()
        np.testing.assert_allclose(np.linalg.norm(d, axis=1), 1.0)
        assert np.linalg.norm(d.mean(0)) < 0.01
        angles = np.arccos(np.clip(d @ d.T, -1.0, 1.0)) + 9.0 * np.eye(100)
        assert angles.min() > 0.8 * (8.0 * np.pi / (100 * 3.0**0.5)) ** 0.5

    def test_tips(self):
        """Round, at the length from the core."""
        ball = TentacleBall((0.0, 0.0, 0.0), 0.1, 30, 0.2, 0.01)
        d = ball._directions()
        assert ball.contains(0.2999 * d).all()
        assert not ball.contains(0.3001 * d).any()
        aside = np.cross(d, [0.3, 0.5, 0.7])
        aside /= np.linalg.norm(aside, axis=1)[:, None]
        assert ball.contains(0.25 * d + 0.0099 * aside).all()
        assert not ball.contains(0.25 * d + 0.0101 * aside).any()
        assert not ball.contains(0.299 * d + 0.006 * aside).any()
        np.testing.assert_allclose(np.abs(ball.bounds).max(), 0.29 * np.abs(d).max() + 0.01)
