"""How many particles a warp has: fewer where there are few, at most one for each of its threads."""

import pytest

from nsf.mpm.access import WARP
from nsf.mpm.scatter import particles_of_warp


@pytest.mark.parametrize(
    ("particles", "each"), [(1, 8), (131_072, 8), (131_073, 16), (262_145, 32), (10**8, 32)]
)
def test_few_particles_are_of_many_warps(particles, each):
    assert particles_of_warp(particles) == each <= WARP
