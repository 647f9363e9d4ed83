"""The whole chain on a mesh of the user's."""

import numpy as np
import pytest

from nsf import config
from nsf.data import Trajectory
from nsf.pipeline import Pipeline
from nsf.scenes import Mesh

#: A few particles, steps and values: seconds for the whole chain.
FEW = (
    "scene=drop",
    "device=cpu",
    "scene.dx=0.04",
    "scene.dt=0.004",
    "scene.steps=24",
    "scene.bodies.body.particles_per_cell=4",
    "scene.design.train=[2000,4000,6000]",
    "scene.design.test=[3000]",
    "field.modes=[8,8,8]",
    "field.beta=4",
    "field.depth=1",
    "trainer.steps=100",
    "latent_dim=4",
    "sampler.size=20",
    "evaluation.trials=0",
    "evaluation.picture_particles=100",
    "evaluation.picture_frames=3",
)


@pytest.fixture
def octahedron(tmp_path):
    """Writes an octahedron of this height to one path."""
    path = tmp_path / "octahedron.obj"

    def write(height):
        tips = [(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, height), (0, 0, -height)]
        faces = [(1, 3, 5), (3, 2, 5), (2, 4, 5), (4, 1, 5), (3, 1, 6), (2, 3, 6), (4, 2, 6), (1, 4, 6)]
        lines = ["v {} {} {}".format(*t) for t in tips] + ["f {} {} {}".format(*f) for f in faces]
        path.write_text("\n".join(lines))
        return path

    return write


def test_chain(octahedron, tmp_path):
    path = octahedron(1.0)

    def pipeline():
        overrides = [*FEW, f"scene.geometry.mesh={path}"]
        return Pipeline(config.load(overrides), say=lambda line: None, root=tmp_path / "runs")

    chain = pipeline()
    for stage in ("simulate", "train", "deploy", "evaluate"):
        chain.run(stage)
    shape = Mesh(str(path), 0.3, (0.5, 0.5, 0.15))
    with Trajectory.open(chain.simulation(chain.scene.case(3000.0)).path / "trajectory.h5") as trajectory:
        x = trajectory.read("x").reshape(-1, trajectory.particles, 3)
        assert trajectory.particles == round(4 * shape.volume / 0.04**3)
    np.testing.assert_allclose(x[0], shape.sample(x.shape[1]), atol=1e-7)
    assert x[-1, :, 2].mean() < x[0, :, 2].mean()
    assert np.isfinite(x).all()
    assert chain.evaluation.complete

    octahedron(2.0)
    changed = pipeline()
    for stage in ("training", "deployment", "evaluation"):
        assert getattr(changed, stage).id != getattr(chain, stage).id
    assert not changed.simulation(changed.scene.case(3000.0)).complete
    octahedron(1.0)
    assert pipeline().evaluation.complete
