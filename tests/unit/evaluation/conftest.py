"""The tiny chain's full-order and reduced run at its held-out value."""

import pytest

from nsf.data import Trajectory
from nsf.deployment import Rollout


@pytest.fixture(scope="module")
def truth(chain):
    with Trajectory.open(chain.trajectory(26.0)) as trajectory:
        yield trajectory


@pytest.fixture(scope="module")
def made(chain):
    return Rollout.open(chain.pipeline.deployment.path / "rollout_0.h5")
