"""A grid that stores only some nodes, and a step over only some particles (paper, section 5.2)."""

import numpy as np
import pytest
import warp as wp

from nsf.errors import ConfigError
from nsf.mpm import (
    FP64,
    BoundaryArrays,
    DomainWalls,
    Forcing,
    Grid,
    GridGeometry,
    GridStep,
    HalfSpace,
    Transfer,
)
from nsf.mpm.grid.nodes import inside

DX, DT = 1.0 / 16.0, 0.002
GEOMETRY = GridGeometry.of_domain((1.0, 1.0, 1.0), DX)
DEVICE = "cpu"
OFFSET = {"quadratic": 0.5, "cubic": 1.0}


def stencil(x, shape):
    """[n, (b + 1)³] flat nodes of each particle's stencil."""
    width = 3 if shape == "quadratic" else 4
    base = np.floor(x / DX - OFFSET[shape]).astype(int)
    steps = np.stack(np.meshgrid(*[np.arange(width)] * 3, indexing="ij"), -1).reshape(-1, 3)
    nodes = base[:, None] + steps
    return np.ravel_multi_index(tuple(np.moveaxis(nodes, -1, 0)), GEOMETRY.nodes)


@pytest.fixture
def particles(block, rng):
    """Position, velocity, affine momentum, Kirchhoff stress, mass and volume of the block."""
    n = len(block)
    return {
        "x": block,
        "v": rng.normal(size=(n, 3)),
        "C": rng.normal(size=(n, 3, 3)),
        "tau": rng.normal(size=(n, 3, 3)),
        "mass": rng.uniform(1.0, 2.0, n),
        "volume0": rng.uniform(1.0, 2.0, n),
    }


def step(particles, shape, integration, sample, nodes=None):
    """P2G over `integration`, update, G2P over `sample` → grid, its mass, the sample's x, v, C, increment."""
    grid = Grid(GEOMETRY, FP64, DEVICE, nodes)
    floor = HalfSpace((0.0, 0.0, 0.45), (0.0, 0.0, 1.0), "separate", 0.3)
    boundaries = BoundaryArrays([floor], DomainWalls(), FP64, DEVICE)
    forcing = Forcing([(0.0, 0.0, -9.0)], boundaries, FP64, DEVICE)
    work = GridStep(grid, forcing, Transfer(shape=shape), DT, FP64, wp.get_device(DEVICE))
    types = {
        "x": FP64.vec3,
        "v": FP64.vec3,
        "C": FP64.mat33,
        "tau": FP64.mat33,
        "mass": FP64.real,
        "volume0": FP64.real,
    }

    def of(rows):
        return {k: wp.array(particles[k][rows], dtype=t, device=DEVICE) for k, t in types.items()}

    work.p2g(**of(integration))
    mass = grid.mass.numpy().copy()
    work.update()
    out = of(sample)
    increment = wp.zeros(len(sample), dtype=FP64.mat33, device=DEVICE)
    work.g2p(out["x"], out["v"], out["C"], increment)
    return grid, mass, [out[k].numpy().copy() for k in ("x", "v", "C")] + [increment.numpy().copy()]


@pytest.mark.parametrize("shape", ["quadratic", "cubic"])
def test_sparse_equals_dense_on_its_nodes(shape, particles):
    every, sample = np.arange(200), np.array([3, 50, 120])
    nodes = np.unique(stencil(particles["x"][sample], shape))
    dense, dense_mass, expected = step(particles, shape, every, sample)
    sparse, sparse_mass, found = step(particles, shape, every, sample, nodes)
    assert sparse.count == len(nodes) < dense.count
    assert sparse.nbytes < dense.nbytes
    assert np.array_equal(sparse_mass, dense_mass[nodes])
    assert np.array_equal(sparse.momentum.numpy(), dense.momentum.numpy()[nodes])
    for a, b in zip(found, expected, strict=True):
        assert np.array_equal(a, b)


@pytest.mark.parametrize("shape", ["quadratic", "cubic"])
def test_a_step_over_the_neighbours_is_exact(shape, particles):
    """Only particles that share a node with the sample matter, and each of them does."""
    sample = np.array([3, 50, 120])
    nodes = np.unique(stencil(particles["x"][sample], shape))
    shares = np.isin(stencil(particles["x"], shape), nodes).any(1)
    needed = np.nonzero(shares)[0]
    _, _, expected = step(particles, shape, np.arange(200), sample)
    _, _, found = step(particles, shape, needed, sample, nodes)
    assert max(np.abs(a - b).max() for a, b in zip(found, expected, strict=True)) <= 1e-12
    dropped = needed[needed != 3][0]
    _, _, wrong = step(particles, shape, needed[needed != dropped], sample, nodes)
    assert max(np.abs(a - b).max() for a, b in zip(wrong, expected, strict=True)) > 1e-9


def test_a_grid_of_several_simulations_is_not_updated_as_a_whole():
    grid = Grid(GEOMETRY, FP64, DEVICE, np.arange(5), runs=2)
    boundaries = BoundaryArrays([], DomainWalls(), FP64, DEVICE)
    forcing = Forcing(np.zeros((2, 3)), boundaries, FP64, DEVICE)
    work = GridStep(grid, forcing, Transfer(), DT, FP64, wp.get_device(DEVICE))
    with pytest.raises(ConfigError, match="use update_g2p"):
        work.update()


def test_clear(particles):
    grid, _, _ = step(particles, "quadratic", np.arange(200), np.arange(3))
    assert grid.mass.numpy().any()
    grid.clear()
    assert not grid.mass.numpy().any()
    assert not grid.momentum.numpy().any()


@wp.kernel(enable_backward=False)
def _stencils_inside(base: wp.array(dtype=wp.vec3i), shape: wp.vec3i, found: wp.array(dtype=wp.int32)):
    p = wp.tid()
    if inside(base[p], 3, shape):
        found[p] = 1


def test_no_integer_far_away_lies_on_the_grid():
    """A GPU turns a huge position into the largest integer; adding to it wraps around."""
    largest, least = np.iinfo(np.int32).max, np.iinfo(np.int32).min
    base = [[0, 0, 0], [5, 6, 7], *(np.eye(3, dtype=int) * far for far in (largest, least, 8, -1))]
    base = np.vstack([np.atleast_2d(b) for b in base]).astype(np.int32)
    found = wp.zeros(len(base), dtype=wp.int32, device="cpu")
    wp.launch(
        _stencils_inside,
        len(base),
        inputs=[wp.array(base, dtype=wp.vec3i, device="cpu"), wp.vec3i(8, 9, 10)],
        outputs=[found],
        device="cpu",
    )
    assert found.numpy().tolist() == [1, 1] + [0] * (len(base) - 2)
