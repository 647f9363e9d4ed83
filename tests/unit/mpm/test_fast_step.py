"""The step as it is taken beside its simplest form: every node swept, Warp's own atomics, stage by stage."""

import dataclasses

import numpy as np
import pytest
import warp as wp

from nsf.mpm import (
    FP64,
    DomainWalls,
    FullOrderMPM,
    Grid,
    GridGeometry,
    HalfSpace,
    ParticleConstants,
    Transfer,
)
from nsf.mpm.materials import (
    DruckerPrager,
    FixedCorotated,
    Hencky,
    HerschelBulkley,
    VonMisesHardening,
    VonMisesSoftening,
)
from nsf.mpm.recording import FrameRecorder
from nsf.mpm.state import cell_order
from nsf.timing import untimed

DX, DT = 1.0 / 16.0, 0.002
GEOMETRY = GridGeometry(DX, (19, 17, 18))  # blocks that reach over the edge in each axis
MATERIALS = [
    FixedCorotated(100.0, 0.3),
    Hencky(100.0, 0.3),
    DruckerPrager(100.0, 0.3, 30.0),
    VonMisesHardening(100.0, 0.3, 1.0, 0.2),
    VonMisesSoftening(100.0, 0.3, 10.0, 2.0),
    HerschelBulkley(100.0, 0.3, 1.0, 0.5),
]
# Relative to the largest value. A GPU adds in another order every time, which 40 steps of contact carry on.
TOLERANCE = {("cpu", "fp64"): 1e-11, ("cpu", "fp32"): 2e-4, ("cuda", "fp64"): 1e-9, ("cuda", "fp32"): 5e-3}


@pytest.fixture
def solver_on(block, rng, device):
    """(material, transfer, precision) → a stretched body thrown against the floor near the walls."""

    def build(material, transfer=Transfer(), precision="fp64"):
        X = block - [0.05, 0.0, 0.1]
        volume0 = np.full(len(X), (0.5 * DX) ** 3)
        constants = ParticleConstants(
            X, volume0, volume0, np.full(len(X), material.mu), np.full(len(X), material.lam)
        )
        v = np.array([2.0, 0.5, -3.0]) + 8.0 * (X - X.mean(0)) @ rng_matrix
        floor = HalfSpace((0.0, 0.0, 0.28), (0.0, 0.0, 1.0), "separate", 0.3)
        return FullOrderMPM(
            constants, material, GEOMETRY, DT, (0.0, 0.0, -10.0), [floor], DomainWalls(), transfer,
            v=v, precision=precision, device=device,
        )  # fmt: skip

    rng_matrix = rng.normal(size=(3, 3))
    return build


def simplest(solver):
    """The same solver on a grid whose every node is listed, so that each is cleared and updated."""
    grid = solver.grid.geometry
    solver.grid = Grid(grid, solver.precision, solver.device, nodes=np.arange(grid.count))
    solver.grid_step.grid = solver.grid
    return solver


def assert_same_run(fast, plain, precision, steps=40):
    fast.step(steps)
    for _ in range(steps):
        plain.timed_step(untimed)
    tolerance = TOLERANCE["cuda" if fast.device.is_cuda else "cpu", precision]
    found, expected = fast.state.numpy(), plain.state.numpy()
    for name, values in expected.items():
        scale = max(np.abs(values).max(), 1e-300)
        assert np.abs(found[name] - values).max() <= tolerance * scale, name
    assert np.abs(expected["tau"]).max() > 0.1
    np.testing.assert_allclose(fast.grid.mass.numpy(), plain.grid.mass.numpy(), atol=tolerance * DX**3)


@pytest.mark.parametrize("precision", ["fp64", "fp32"])
@pytest.mark.parametrize("material", MATERIALS, ids=lambda m: type(m).__name__)
def test_every_law(material, precision, solver_on):
    plain = simplest(solver_on(material, Transfer(deterministic=True), precision))
    assert_same_run(solver_on(material, Transfer(), precision), plain, precision)


@pytest.mark.parametrize("precision", ["fp64", "fp32"])
@pytest.mark.parametrize("shape", ["quadratic", "cubic"])
@pytest.mark.parametrize("scheme", ["pic", "apic", "rpic"])
def test_every_transfer(scheme, shape, precision, solver_on):
    transfer = Transfer(scheme, shape, 0.25 if scheme == "rpic" else 0.0)
    ordered = dataclasses.replace(transfer, deterministic=True)
    plain = simplest(solver_on(MATERIALS[0], ordered, precision))
    assert_same_run(solver_on(MATERIALS[0], transfer, precision), plain, precision)


@pytest.mark.parametrize("precision", ["fp64", "fp32"])
@pytest.mark.parametrize("shape", ["quadratic", "cubic"])
def test_few_particles_get_from_momenta_what_update_and_g2p_give(shape, precision, solver_on):
    solver = solver_on(MATERIALS[0], Transfer(shape=shape), precision)
    solver.step(40)
    solver.p2g()
    grid, state = solver.grid, solver.state
    lowest = np.argsort(state.x.rows.numpy()[:, 2])[:30]
    x, v = (
        wp.array(a.rows.numpy()[lowest], dtype=solver.precision.vec3, device=solver.device)
        for a in (state.x, state.v)
    )
    moved, started, momenta = 20, [a.numpy().copy() for a in (x, v)], grid.values.numpy().copy()
    solver.grid_step.update_g2p(x, v, moved)
    np.testing.assert_array_equal(grid.values.numpy(), momenta)
    solver.grid_step.update()
    assert np.abs(grid.momentum.numpy()[momenta[:, 3] > 0, 2]).min() == 0.0  # the floor holds some nodes
    solver.g2p()
    tolerance = {"fp64": 1e-13, "fp32": 1e-5}[precision]
    for found, before, expected in zip((x, v), started, (state.x, state.v), strict=True):
        values = expected.rows.numpy()[lowest]
        np.testing.assert_allclose(
            found.numpy()[:moved], values[:moved], rtol=0, atol=tolerance * np.abs(values).max()
        )
        np.testing.assert_array_equal(found.numpy()[moved:], before[moved:])


def test_a_step_is_its_stages(solver_on):
    """What a breakdown times is what a run does."""
    whole, staged = solver_on(MATERIALS[2]), solver_on(MATERIALS[2])
    whole.step(20)
    for _ in range(20):
        staged.timed_step(untimed)
    assert staged.steps_taken == 20
    a, b = whole.state.numpy(), staged.state.numpy()
    for name in a:
        np.testing.assert_allclose(a[name], b[name], atol=1e-9 * np.abs(b[name]).max())


@pytest.mark.parametrize("shape", ["quadratic", "cubic"])
def test_blocks_are_those_that_particles_reach(shape, solver_on):
    solver = solver_on(MATERIALS[0], Transfer(shape=shape))
    solver.step(10)
    early = set(solver.grid.blocks.numpy()[: solver.grid.listed.numpy()[0]].tolist())
    solver.step(90)
    x = solver.state.numpy()["x"]
    solver.p2g()
    grid = solver.grid
    width, offset = {"quadratic": (3, 0.5), "cubic": (4, 1.0)}[shape]
    base = np.floor(x / DX - offset).astype(int)
    corners = [(base + (width - 1) * np.array(corner)) // 4 for corner in np.ndindex(2, 2, 2)]
    expected = {int(b) for c in corners for b in np.ravel_multi_index(tuple(c.T), tuple(grid.block_shape))}
    listed = grid.blocks.numpy()[: grid.listed.numpy()[0]].tolist()
    assert len(listed) == len(expected)
    assert set(listed) == expected != early
    assert set(np.flatnonzero(grid.marks.numpy())) == expected
    # Nothing is left where the body was before.
    assert grid.mass.numpy().sum() == pytest.approx(solver.constants.mass.sum(), rel=1e-12)
    nodes = np.stack(np.unravel_index(np.flatnonzero(grid.mass.numpy()), GEOMETRY.nodes), 1) // 4
    assert set(np.ravel_multi_index(tuple(nodes.T), tuple(grid.block_shape)).tolist()) <= expected


def test_a_particle_off_the_grid_lists_no_block(solver_on):
    solver = solver_on(MATERIALS[0])
    x = solver.state.numpy()["x"]
    x[:] = [-3.0, 0.5, 1e30]
    x[0] = np.nan
    solver.state.x.assign(x)
    solver.p2g()
    assert solver.grid.listed.numpy()[0] == 0
    assert not solver.grid.values.numpy().any()


@pytest.mark.parametrize("shape", ["quadratic", "cubic"])
def test_rows_lie_in_cell_order_and_nobody_sees_it(shape, block, solver_on):
    solver = solver_on(MATERIALS[0], Transfer(shape=shape))
    X, state = solver.constants.X, solver.state
    np.testing.assert_array_equal(state.numpy()["x"], X)
    order = state.order.numpy()
    assert sorted(order) == list(range(len(X)))
    assert (order != np.arange(len(X))).any()
    np.testing.assert_array_equal(state.x.rows.numpy(), X[order])
    cells = np.floor(X[order] / DX - {"quadratic": 0.5, "cubic": 1.0}[shape]).astype(int)
    for of in (cells, cells // 4):
        changes = 1 + (np.diff(of, axis=0) != 0).any(1).sum()
        assert changes == len(np.unique(of, axis=0))  # no cell and no block is met twice
    solver.step(3)
    values = {"x": X + 0.25, "tau": np.arange(9.0 * len(X)).reshape(-1, 3, 3)}
    for name, of in values.items():
        getattr(state, name).assign(of)
        np.testing.assert_array_equal(state.numpy()[name], of)


def test_frames_are_in_the_particles_order(solver_on):
    solver = solver_on(MATERIALS[2])
    solver.step(5)
    recorder = FrameRecorder(solver.state, solver.precision, FP64)
    recorder.record()
    block = recorder.take()
    (frame,) = block
    state = solver.state.numpy()
    for name in ("x", "v", "C"):
        np.testing.assert_array_equal(frame[name], state[name].reshape(len(frame[name]), -1))
    np.testing.assert_array_equal(frame["tau"][:, 1], state["tau"][:, 0, 1])


def test_memory_of_a_block_is_used_again_once_it_is_done(solver_on):
    solver = solver_on(MATERIALS[2])
    recorder = FrameRecorder(solver.state, solver.precision, FP64)

    def taken():
        recorder.record()
        solver.step()
        return recorder.take()

    first, second = taken(), taken()
    kept = first.fields["x"].copy()
    assert not np.shares_memory(first.fields["x"], second.fields["x"])
    assert (second.fields["x"] != kept).any()
    np.testing.assert_array_equal(first.fields["x"], kept)
    first.done()
    assert np.shares_memory(first.fields["x"], taken().fields["x"])


def test_particles_of_no_cell_have_an_order():
    x = np.array([[np.nan, 0.5, 0.5], [1e300, -1e300, 0.5], [0.5, 0.5, 0.5], [-1.0, np.inf, 0.0]])
    assert sorted(cell_order(x, DX, 0.5)) == [0, 1, 2, 3]
