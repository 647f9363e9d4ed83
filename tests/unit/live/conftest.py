"""The tiny chain's deployment, run live."""

import pytest

from nsf.live.model import LiveModel
from nsf.live.player import Player


@pytest.fixture(scope="session")
def model(chain):
    """The live model; runs hold all that changes, so tests share it."""
    return LiveModel(chain.pipeline.deployment, points=200, device="cpu")


@pytest.fixture
def player(model):
    """A player whose worker is not started: tests do its work."""
    return Player(model)
