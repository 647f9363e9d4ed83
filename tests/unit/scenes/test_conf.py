"""Every yaml of the scene, material and transfer groups builds what it names."""

import numpy as np
import pytest
from omegaconf import OmegaConf

from nsf import config as configuration
from nsf import load_scene
from nsf.mpm import Transfer
from nsf.mpm.materials import Material, deformation_path, drive
from nsf.paths import CONF

#: What scenes set in a material; any other open value gets 0.05.
OPEN = {"E": 1000.0, "nu": 0.3, "friction_angle": 30.0}


def names(group):
    found = sorted(f.stem for f in (CONF / group).glob("*.yaml"))
    assert found
    return found


@pytest.mark.parametrize("name", names("material"))
def test_material(name):
    node = OmegaConf.load(CONF / "material" / f"{name}.yaml")
    for key in [k for k in node if OmegaConf.is_missing(node, k)]:
        node[key] = OPEN.get(key, 0.05)
    material = configuration.build(node, "material")
    assert isinstance(material, Material)
    tau = drive(material, deformation_path("isotropic_compression", 0.01, 5)[1], 0.01)
    assert np.isfinite(tau).all()
    assert np.trace(tau[-1]) < 0.0


@pytest.mark.parametrize("name", names("transfer"))
def test_transfer(name):
    transfer = configuration.build(OmegaConf.load(CONF / "transfer" / f"{name}.yaml"), "transfer")
    assert isinstance(transfer, Transfer)
    assert transfer.scheme == name


@pytest.mark.parametrize("name", names("scene"))
def test_small_scene_takes_a_step(name):
    scene = load_scene(name, ["scale=small"])
    assert scene.name == name
    solver = scene.full_order(device="cpu")
    solver.step()
    solver.check()
