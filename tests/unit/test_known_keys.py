"""A key that nothing reads is refused wherever it stands, with the nearest one that there is."""

import inspect
import re

import pytest
import yaml

from nsf import config
from nsf.code import arguments
from nsf.config import targets
from nsf.errors import ConfigError
from nsf.paths import CONF, groups

MISPLACED = [
    ("+scene.gravty=[0,0,-1]", "'scene.gravty'; did you mean scene.gravity?"),
    ("++scene.step=20", "'scene.step'; did you mean scene.steps?"),
    ("+gravity=[0,0,-1]", "'gravity'; did you mean scene.gravity?"),
    ("+lattent_dim=3", "'lattent_dim'; did you mean latent_dim?"),
    ("+deploy.splitt=test", "'deploy.splitt'; did you mean deploy.split?"),
    ("+reduction.membrs=3", "'reduction.membrs'; did you mean reduction.members?"),
    ("+evaluation.coarse_of=[2]", "'evaluation.coarse_of'"),
    ("+field.nois=0.1", "'field.nois'; did you mean field.noise?"),
    ("+projector.iteration=3", "'projector.iteration'; did you mean projector.iterations?"),
    ("+scene.walls.paddin=3", "'scene.walls.paddin'; did you mean scene.walls.padding?"),
    ("+scene.bodies.column.densty=3", "did you mean scene.bodies.column.density?"),
    ("+scene.bodies.column.shape.hight=3", "did you mean scene.bodies.column.shape.height?"),
    ("+scene.colliders.floor.motio={}", "did you mean scene.colliders.floor.motion?"),
    ("+scene.forcing={gravty: {}}", "'scene.forcing.gravty'; did you mean scene.forcing.gravity?"),
    ("+scene.design.tests=[30]", "did you mean scene.design.test?"),
    ("+scene.paper.nsf.deltas=1", "did you mean scene.paper.nsf.delta?"),
    ("+point.points=3", "unknown key 'point'"),
    ("+scene.mine={used: 3, other: 4}", "'scene.mine.other'; scene.mine has used"),
]


@pytest.mark.parametrize(("override", "told"), MISPLACED)
def test_a_key_that_nothing_reads_is_refused(override, told):
    more = ["material.E='${scene.mine.used}'"] if "mine" in override else []
    with pytest.raises(ConfigError, match=re.escape(told)):
        config.load(["scene=sand", override, *more])


def test_a_configuration_with_several_is_told_of_each():
    overrides = ["scene=drop", "+scene.gravty=[0,0,-1.62]", "+scene.step=20", "+scene.geometry.heigth=0.1"]
    with pytest.raises(ConfigError) as refused:
        config.load([*overrides, "+gravity=[0,0,-1.62]", "+lattent_dim=3"])
    for key in ("scene.gravity", "scene.steps", "scene.geometry.height", "latent_dim"):
        assert f"did you mean {key}?" in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_key_that_a_value_refers_to_is_read():
    found = config.load(["scene=sand", "+scene.stiff={value: 3000.0}", "material.E='${scene.stiff.value}'"])
    assert config.resolve(found).material.E == 3000.0


@pytest.mark.parametrize("group", [group for group in groups() if group in targets.KINDS])
def test_arguments_are_read_from_the_text_of_classes(group):
    """Without an import, which takes a second, they are those that Python knows."""
    for option in groups()[group]:
        node = yaml.safe_load((CONF / group / f"{option}.yaml").read_text())
        made_of = targets.named_class(node["_target_"], (group,))
        assert arguments(node["_target_"]).keys() == set(inspect.signature(made_of).parameters)


@pytest.mark.parametrize("name", ["nsf.scenes.mesh_or_ball", "nsf.mpm.Cuboid", "nsf.mpm.HalfSpace"])
def test_arguments_of_functions_and_of_bases(name):
    kind = ("scene", "bodies", "a", "shape") if "scenes" in name else ("scene", "colliders", "a")
    assert arguments(name).keys() == set(inspect.signature(targets.named_class(name, kind)).parameters)
