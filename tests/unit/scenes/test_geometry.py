"""Shapes and their sampling."""

import numpy as np
import pytest

from nsf.errors import ConfigError
from nsf.scenes import Box, Cylinder

SHAPES = [
    pytest.param(Box((0.1, 0.2, 0.3), (0.5, 0.4, 0.9)), id="box"),
    pytest.param(Cylinder((0.5, 0.5, 0.13), 0.2, 0.3), id="cylinder"),
    pytest.param(Cylinder((0.5, 0.5, 0.13), 0.02, 0.4), id="thin cylinder"),
    pytest.param(Box((0.2, 0.2, 0.4), (0.8, 0.8, 0.5)), id="slab"),
]


@pytest.mark.parametrize("shape", SHAPES)
class TestSampling:
    @pytest.mark.parametrize("count", [1, 17, 1000, 70000])
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

    @pytest.mark.parametrize(("count", "start"), [(10, 0), (500, 1500), (3, 66000)])
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
        assert counts[full].std() < 0.65 * 12.0**0.5

    def test_no_two_points_close(self, shape):
        """The smallest gap is a good part of the lattice spacing; random points come 5 times closer."""
        count = 1500
        x = shape.sample(count)
        squared = ((x[:, None] - x[None]) ** 2).sum(-1) + np.eye(count)
        assert squared.min() ** 0.5 > 0.3 * (shape.volume / count) ** (1.0 / 3.0)

    def test_volume_against_counting(self, shape):
        lower, upper = shape.bounds
        n = 60
        axes = [lo + (hi - lo) * (np.arange(n) + 0.5) / n for lo, hi in zip(lower, upper, strict=True)]
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
        counted = shape.contains(grid).mean() * np.prod(upper - lower)
        assert shape.volume == pytest.approx(counted, rel=0.01)

    @pytest.mark.parametrize("count", [0, -3])
    def test_count_is_refused(self, shape, count):
        with pytest.raises(ConfigError, match=f"particles={count}"):
            shape.sample(count)


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
        (lambda: Cylinder((0.5, 0.5, 0.1), 0.0, 1.0), "radius=0.0"),
        (lambda: Cylinder((0.5, 0.5, 0.1), 0.1, -1.0), "height=-1.0"),
        (lambda: Cylinder((0.5, 0.5), 0.1, 1.0), r"base=\(0.5, 0.5\)"),
    ],
)
def test_refused(build, quoted):
    with pytest.raises(ConfigError, match=quoted):
        build()
