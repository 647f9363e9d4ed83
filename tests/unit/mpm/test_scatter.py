"""P2G of several simulations beside its sums, and how many particles a warp of a GPU has."""

from itertools import pairwise

import numpy as np
import pytest
import warp as wp

from nsf.mpm import BoundaryArrays, DomainWalls, Forcing, Grid, GridGeometry, GridStep, Transfer, precision_of
from nsf.mpm.native.access import WARP
from nsf.mpm.state import cell_order
from nsf.mpm.transfer.scatter import particles_of_warp

DX, DT = 0.25, 0.002
GEOMETRY = GridGeometry(DX, (11, 9, 10))


@pytest.mark.parametrize(
    ("particles", "each"), [(1, 8), (131_072, 8), (131_073, 16), (262_145, 32), (10**8, 32)]
)
def test_few_particles_are_of_many_warps(particles, each):
    assert particles_of_warp(particles) == each <= WARP


def spline(offset, degree):
    """Cardinal B-spline about 0 and its derivative, by the recursion of de Boor."""
    if degree == 0:
        return ((offset >= -0.5) & (offset < 0.5)).astype(float), np.zeros_like(offset)
    half = (degree + 1) / 2
    (left, _), (right, _) = (spline(offset + d, degree - 1) for d in (0.5, -0.5))
    return ((half + offset) * left + (half - offset) * right) / degree, left - right


def sums(particles, degree, nodes):
    """[n, 4] momentum, with the impulse of the stress, and mass of nodes, in fp64."""
    offset = nodes[:, None] - particles["x"] / DX  # [n, P, 3]
    w, slope = spline(offset, degree)
    weight = w.prod(2)
    gradient = np.stack([slope[..., i] * np.delete(w, i, 2).prod(2) for i in range(3)], 2) / -DX
    m = particles["mass"]
    carried = particles["v"] + np.einsum("pij,npj->npi", particles["C"], DX * offset)
    force = np.einsum("p,pij,npj->ni", particles["volume0"], particles["tau"], gradient)
    return np.column_stack([np.einsum("np,p,npi->ni", weight, m, carried) - DT * force, weight @ m])


@pytest.mark.parametrize("each", [8, 16, 32])
@pytest.mark.parametrize(("shape", "degree"), [("quadratic", 2), ("cubic", 3)])
@pytest.mark.parametrize(("precision", "tolerance"), [("fp64", 1e-13), ("fp32", 1e-5)])
def test_p2g_of_several_simulations(precision, tolerance, shape, degree, each, rng, device, monkeypatch):
    """Of particles in cell order, whose cells follow each other along the last axis, some off the grid.

    The last cell of one simulation is the first of the next, or comes before it: they stay apart.
    """
    if device == "cpu" and each != 32:
        pytest.skip("warps are of a GPU")
    monkeypatch.setattr("nsf.mpm.step.particles_of_warp", lambda particles: each)
    types, n, count = precision_of(precision), 203, 3
    listed = np.sort(rng.permutation(GEOMETRY.count)[: GEOMETRY.count * 2 // 3]).astype(np.int32)
    grid = Grid(GEOMETRY, types, device, listed, count)
    boundaries = BoundaryArrays([], DomainWalls(), types, device)
    forcing = Forcing(np.zeros((count, 3)), boundaries, types, device)
    work = GridStep(grid, forcing, Transfer(shape=shape), DT, types, wp.get_device(device))
    runs = []
    for _ in range(count):
        x = np.array([0.6, 0.5, 0.5]) + [0.5, 0.5, 1.2] * rng.random((n, 3))
        x = x[cell_order(x, DX, (degree - 1) / 2)]
        x[rng.random(n) < 0.2] = -1.0
        runs.append({
            "x": x, "v": rng.normal(size=(n, 3)), "C": rng.normal(size=(n, 3, 3)),
            "tau": 100.0 * rng.normal(size=(n, 3, 3)), "mass": 1.0 + rng.random(n), "volume0": rng.random(n),
        })  # fmt: skip
    seam = np.array([2.0, 2.0, 3.0]) + degree / 2 + 0.3 * rng.random((2, 2, 4, 3))  # [Δx]
    seam[1, 1, :, 2] += 1.0
    for (before, after), (tail, head) in zip(pairwise(runs), DX * seam, strict=True):
        before["x"][-4:], after["x"][:4] = tail, head
    kinds = {"x": types.vec3, "v": types.vec3, "C": types.mat33, "tau": types.mat33}
    together = {name: np.concatenate([run[name] for run in runs]) for name in runs[0]}
    work.p2g(**{k: wp.array(of, dtype=kinds.get(k, types.real), device=device) for k, of in together.items()})
    found = grid.values.numpy().reshape(count, -1, 4)
    nodes = np.stack(np.unravel_index(listed, GEOMETRY.nodes), 1)
    for values, run in zip(found, runs, strict=True):
        on_grid = run["x"][:, 0] > 0
        expected = sums({name: of[on_grid] for name, of in run.items()}, degree, nodes)
        np.testing.assert_allclose(values, expected, rtol=0, atol=tolerance * np.abs(expected).max())
        assert np.abs(expected).max() > 1.0
