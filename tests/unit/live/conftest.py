"""The tiny chain's deployment, run live."""

import shutil

import pytest
from tiny import TAUGHT

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
def taught_model(taught_root, pipeline_at, tmp_path_factory):
    """The live model of the tiny chain by a recurrence that was hardly taught, at three held-out values."""
    root = shutil.copytree(taught_root, tmp_path_factory.mktemp("taught") / "runs")
    pipeline = pipeline_at(root, *TAUGHT, "model.stress=0", "scene.design.test=[24,26,34]")
    pipeline.simulate()
    pipeline.deploy()
    return LiveModel(pipeline.deployment, device="cpu", surface=True)


@pytest.fixture(scope="session")
def tilting_model(tmp_path_factory):
    """A tiny soft block under gravity that wanders, by a recurrence that was hardly taught."""
    from nsf import config
    from nsf.pipeline import Pipeline

    taught = [f"model.{key}" for key in ("runs=8", "stress=4", "members=2", "descents=200", "width=32")]
    keys = [
        "scene=block", "scale=small", "device=cpu", "model=recurrence", *taught,
        "scene.dx=0.03", "scene.dt=0.002", "scene.steps=80", "scene.bodies.block.particles=400",
        "scene.design.train=6", "scene.design.validation=1", "scene.design.test=2",
        "field.modes=[12,12,12]", "field.beta=4", "field.depth=1", "trainer.steps=200", "latent_dim=4",
        "sampler.size=40",
    ]  # fmt: skip
    pipeline = Pipeline(
        config.load(keys), say=lambda line: None, root=tmp_path_factory.mktemp("tilting") / "runs"
    )
    for stage in ("simulate", "train", "deploy"):
        pipeline.run(stage)
    return LiveModel(pipeline.deployment, device="cpu", surface=True)
