"""A tiny column of sand that is pushed, by a recurrence that was hardly taught: two parameters."""

import pytest

from nsf.inverse import Model

#: The friction angle, and the speed at which the column starts, which only the scene's configuration knows.
TWO = (
    "model=recurrence",
    *("model.runs=16", "model.descents=150", "model.width=32", "model.members=2"),
    "scene.bodies.column.velocity=[0.1,0,0]",
    "+scene.parameters.friction_angle.range=[22,38]",
    "+scene.parameters.speed={key:scene.bodies.column.velocity.0,unit:m/s,range:[0.05,0.3]}",
    "scene.design={_target_:nsf.scenes.Sobol,train:8,validation:4,test:2}",
)


@pytest.fixture(scope="session")
def deployed(pipeline_at, stored):
    """The chain, deployed."""

    def make(folder):
        for stage in ("simulate", "train", "deploy"):
            pipeline_at(folder / "runs", *TWO).run(stage)

    return pipeline_at(stored("inverse", make) / "runs", *TWO)


@pytest.fixture(scope="session")
def model(deployed):
    """Its model."""
    return Model(deployed.deployment, "cpu")
