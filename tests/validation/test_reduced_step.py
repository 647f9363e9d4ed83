"""The reduced MPM step (paper section 5.2): "There is no approximation in this step"."""

import numpy as np
import pytest
import torch
import warp as wp

import nsf.scenes
from nsf.dynamics import NeighbourSearch
from nsf.dynamics.integration import particle_sets
from nsf.dynamics.interop import as_matrices, as_scalars, as_vectors
from nsf.mpm import FP64, BoundaryArrays, Grid, GridStep

STEPS = 40


@pytest.fixture(scope="module", params=["apic", "pic"])
def mid_run(request):
    """A sand column in mid-collapse and its state one full-order step later."""
    overrides = [f"transfer={request.param}"]
    scene = nsf.scenes.load("sand", overrides)
    solver = scene.full_order({"friction_angle": 30.0}, device="cpu")
    solver.step(STEPS)
    before = {name: torch.tensor(value) for name, value in solver.state.numpy().items()}
    solver.step(1)
    return scene, before, torch.tensor(solver.state.numpy()["x"])


def moved_sample(scene, state, rows, sample, nodes):
    """Positions [s, 3] of the sample particles after one step over `rows` (which start with the sample)."""
    constants = scene.particles()
    chosen = {name: state[name][rows].contiguous() for name in ("x", "v", "C", "tau")}
    mass, volume0 = (torch.tensor(getattr(constants, k)[rows]) for k in ("mass", "volume0"))
    device = wp.get_device("cpu")
    boundaries = BoundaryArrays(scene.colliders, scene.walls, FP64, device)
    grid = Grid(scene.grid, FP64, device, nodes=nodes)
    step = GridStep(grid, boundaries, scene.transfer, scene.gravity, scene.dt, FP64, device)
    vectors = [as_vectors(chosen[k], FP64) for k in ("x", "v")]
    matrices = [as_matrices(chosen[k], FP64) for k in ("C", "tau")]
    step.p2g(*vectors, *matrices, as_scalars(mass), as_scalars(volume0))
    step.update()
    s = len(sample)
    increment = torch.zeros(s, 3, 3, dtype=torch.float64)
    heads = [as_vectors(chosen[k][:s], FP64) for k in ("x", "v")]
    step.g2p(*heads, as_matrices(chosen["C"][:s], FP64), as_matrices(increment, FP64))
    return chosen["x"][:s]


def sets_of(scene, x, sample):
    search = NeighbourSearch(scene.grid, scene.transfer.shape, FP64, wp.get_device("cpu"))
    marked = search.no_nodes(x.device)
    search.mark_nodes(x[sample].contiguous(), marked)
    return particle_sets(sample, search.needed(x, torch.as_tensor(sample)), marked)


@pytest.mark.parametrize("sparse", [False, True])
def test_integration_particles_move_the_sample_as_all_particles_do(mid_run, sparse):
    scene, before, after = mid_run
    sample = np.sort(np.random.default_rng(1).permutation(len(after))[:4])
    sets = sets_of(scene, before["x"], sample)
    assert 4 < len(sets.integration) < 0.8 * len(after)  # otherwise the test shows nothing
    moved = moved_sample(scene, before, sets.integration, sample, sets.nodes if sparse else None)
    assert (moved - after[sample]).abs().max() <= 1e-12


def test_a_dropped_particle_is_seen(mid_run):
    scene, before, after = mid_run
    sample = np.sort(np.random.default_rng(1).permutation(len(after))[:4])
    sets = sets_of(scene, before["x"], sample)
    # The particle nearest to a sample particle is certainly needed.
    others = sets.integration[4:]
    nearest = others[(before["x"][others] - before["x"][sample[0]]).norm(dim=1).argmin()]
    rows = sets.integration[sets.integration != nearest]
    moved = moved_sample(scene, before, rows, sample, None)
    assert (moved - after[sample]).abs().max() > 1e-9


def test_every_needed_particle_is_flagged_and_no_other(mid_run):
    """Section 5.4 a and b by brute force over nodes and weights."""
    scene, before, _ = mid_run
    x, dx = before["x"].numpy(), scene.dx
    sample = np.array([3, 700, 1900])

    def stencil(points):
        base = np.floor(points / dx - 0.5).astype(int)
        return {
            tuple(b + np.array([i, j, k])) for b in base for i in range(3) for j in range(3) for k in range(3)
        }

    nodes = stencil(x[sample])
    expected = np.array([bool(stencil(p[None]) & nodes) for p in x])
    needed = sets_of(scene, before["x"], sample).integration
    assert set(needed) == set(np.flatnonzero(expected))
