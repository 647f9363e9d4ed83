"""Collapse of a sand column: run-out against aspect ratio (physics.md, section 3; Lube et al. 2004)."""

import math

import numpy as np
import pytest

from nsf.mpm import DomainWalls, HalfSpace
from nsf.mpm.materials import DruckerPrager

G, RHO, CELLS = 10.0, 1000.0, 4


@pytest.fixture
def run_out(lattice, solver_of):
    """a → (r∞ − r₀)/r₀ of a quarter of a column of radius 1 m and height a, 4 cells a radius.

    r∞ holds 98 % of the mass: the last grains that bounced ahead are not the deposit's edge.
    """

    def run(a):
        dx = 1.0 / CELLS
        edge = 3.0 * dx + 1e-9  # the planes lie a hair beyond a layer of nodes, which belongs to them
        X = lattice([0.0] * 3, [1.0, 1.0, a], 0.5 * dx)
        X = X[np.hypot(X[:, 0], X[:, 1]) < 1.0] + edge
        side = edge + 1.0 + 2.2 * math.sqrt(a) + 4.0 * dx
        material = DruckerPrager(2e6, 0.2, 31.0)
        dt = 0.5 * dx / math.sqrt((material.lam + 2.0 * material.mu) / RHO)
        colliders = [
            HalfSpace((0.0, 0.0, edge), (0.0, 0.0, 1.0), "separate", 0.5),
            HalfSpace((edge, 0.0, 0.0), (1.0, 0.0, 0.0), "slip"),
            HalfSpace((0.0, edge, 0.0), (0.0, 1.0, 0.0), "slip"),
        ]
        size = (side, side, edge + a + 4.0 * dx)
        solver = solver_of(
            X,
            0.5 * dx,
            dx,
            dt,
            size,
            RHO,
            material,
            gravity=(0.0, 0.0, -G),
            colliders=colliders,
            walls=DomainWalls(),
        )
        solver.step(math.ceil(3.5 * math.sqrt(2.0 * a / G) / dt))  # at rest from 2 √(2h/g) on
        x = solver.state.x.numpy() - edge
        assert np.linalg.norm(solver.state.v.numpy(), axis=1).max() < 0.05 * math.sqrt(G * a)
        return np.quantile(np.hypot(x[:, 0], x[:, 1]), 0.98) - 1.0

    return run


def test_taller_columns_run_out_farther(run_out):
    """And by less than in proportion to their height."""
    low, high = run_out(2.0), run_out(3.5)
    assert low < high < 3.5 / 2.0 * low


@pytest.mark.slow
def test_run_out_grows_with_the_root_of_the_aspect_ratio(run_out):
    """Exponent 1/2 within 0.1 for tall columns (observed 0.49; prefactor 1.3, Lube et al. 1.6).

    Lube et al. see the root from a = 1.7 on; at 4 cells a radius it starts at 5, below which the
    deposit's edge is thinner than a cell and the exponent is 0.75.
    """
    a = np.array([5.0, 10.0, 20.0])
    reach = np.array([run_out(x) for x in a])
    exponent, log_prefactor = np.polyfit(np.log(a), np.log(reach), 1)
    print(
        f"run-out {np.round(reach, 3)}, exponent {exponent:.3f}, prefactor {(reach / np.sqrt(a)).mean():.3f}"
    )
    assert exponent == pytest.approx(0.5, abs=0.1)
    assert math.exp(log_prefactor) > 1.0
