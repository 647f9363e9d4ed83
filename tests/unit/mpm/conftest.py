"""What the unit tests of the material point method share."""

import numpy as np
import pytest

from nsf.mpm import DomainWalls, FullOrderMPM, GridGeometry, ParticleConstants
from nsf.mpm.materials import FixedCorotated

DX = 1.0 / 16.0


@pytest.fixture
def rng():
    return np.random.default_rng(7)


@pytest.fixture
def constants_of():
    """(X, E) → particles of density 1 and volume (Δx/2)³."""

    def build(X, E=10.0):
        P, material = len(X), FixedCorotated(E, 0.3)
        volume0 = np.full(P, (0.5 * DX) ** 3)
        return ParticleConstants(X, volume0, volume0, np.full(P, material.mu), np.full(P, material.lam))

    return build


@pytest.fixture
def solver_of(constants_of):
    """(X, dt, E, ...) → a solver in the unit cube, dx = 1/16."""

    def build(X, dt=0.002, E=10.0, material=None, **options):
        options.setdefault("walls", DomainWalls("separate", 1))
        grid = GridGeometry.of_domain((1.0, 1.0, 1.0), DX)
        return FullOrderMPM(
            constants_of(X, E), material or FixedCorotated(E, 0.3), grid, dt, device="cpu", **options
        )

    return build


@pytest.fixture
def block(rng):
    """200 particles at random in the middle of the unit cube."""
    return rng.uniform(0.4, 0.6, (200, 3))
