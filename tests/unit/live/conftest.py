"""The tiny chain's deployment, run live."""

import shutil

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


@pytest.fixture(scope="session")
def taught_model(chain, pipeline_at, tmp_path_factory):
    """The live model of the tiny chain by operators that were hardly taught, at three held-out values."""
    root = shutil.copytree(chain.root, tmp_path_factory.mktemp("taught") / "runs")
    taught = [f"engine.teaching.{key}" for key in ("steps=400", "descent=300", "rounds=1", "width=32")]
    pipeline = pipeline_at(root, "engine=operators", *taught, "scene.design.test=[24,26,34]")
    pipeline.simulate()
    pipeline.deploy()
    return LiveModel(pipeline.deployment, device="cpu", surface=True)
