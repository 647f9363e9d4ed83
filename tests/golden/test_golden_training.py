"""The fields that a short training leaves: to a looser tolerance, since its bits are those of a machine.

Single precision, 3 steps of Adam, and modes of an eigenvalue problem.
"""

import pytest
from chains import Chains, close, read, trained
from configurations import FEW, PAPER


@pytest.fixture(scope="module")
def untouched(chains):
    """Chains with the same trajectories, whose networks keep what training leaves."""
    return Chains(chains.root, FEW)


@pytest.mark.parametrize("scene", PAPER)
def test_fields_are_nearly_the_same(untouched, scene):
    close(trained(untouched, scene), read("training")[scene], 1e-4, scene)
