"""Every option of every configuration group composes and builds what it names."""

from itertools import zip_longest
from operator import itemgetter

import numpy as np
import pytest

from nsf import config
from nsf.config.scenes import config_of, scene_of
from nsf.mpm.materials import PATHS, deformation_path, drive
from nsf.mpm.stability import check_time_step
from nsf.paths import CONF, groups
from nsf.pipeline import Pipeline
from nsf.scenes.checks import check_physics
from nsf.scenes.identity import plain_scene
from nsf.scenes.resolution import resolution_warnings
from nsf.validation import PROBLEMS

GROUPS = groups()
#: A scene sets its material's constants, so a law alone is composed with the material point.
APART = ("scene", "material", "hydra/launcher")
#: Scenes; those of published problems run in tests/validation.
SCENES = [pytest.param(n, marks=[pytest.mark.slow] * (n in PROBLEMS)) for n in GROUPS["scene"]]
CHAIN = [[f"{g}={option}" for option in GROUPS[g]] for g in GROUPS if g not in APART]


def is_scaled(choice):
    """Few options are others at the paper's scale, whose particles take seconds to place."""
    return "scaled" in (CONF / f"{choice.replace('=', '/')}.yaml").read_text(encoding="utf-8")


@pytest.mark.parametrize("scale", ["small", "paper"])
def test_options_build(scale):
    """Each with others of other groups, as nearly every one may stand with every other."""
    choices = [own if scale == "small" else list(filter(is_scaled, own)) for own in CHAIN]
    for job in zip_longest(*choices):
        Pipeline(config.load([*filter(None, job), f"scale={scale}", "device=cpu"])).check()


@pytest.mark.parametrize("name", GROUPS["hydra/launcher"])
def test_launcher_composes(name):
    assert config.launching([f"hydra/launcher={name}"])[0].hydra.launcher


@pytest.mark.parametrize("scale", ["small", pytest.param("paper", marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", SCENES)
def test_scene_is_runnable(name, scale):
    """In the cases at the ends of each range: particles in the domain, a stable step, no body in another."""
    scene = Pipeline(config.load([f"scene={name}", f"scale={scale}", "device=cpu"])).check().scene
    assert scene.name == name
    assert plain_scene(scene_of(config_of(scene))) == plain_scene(scene)
    ends = {end(scene.split.cases, key=itemgetter(of)) for of in scene.varied for end in (min, max)}
    for case in sorted(ends):
        at = scene.at(case)
        assert at.case() == case
        constants = at.particles()
        assert len(constants) == at.particle_count
        check_time_step(constants, at.initial_velocity(), at.dx, at.dt)
        check_physics(at)
    assert resolution_warnings(scene) == []
    solver = scene.full_order(device="cpu")
    if scale == "small":
        solver.step()
        solver.check()


@pytest.mark.parametrize("name", GROUPS["material"])
def test_material_follows_every_path(name):
    material = config.build(config.load([f"material={name}"], "point").material, "material")
    for path in PATHS:
        tau = drive(material, deformation_path(path, 0.01, 5)[1], dt=1e-3)
        assert np.isfinite(tau).all()
        assert np.abs(tau - tau.swapaxes(1, 2)).max() <= 1e-9 * np.abs(tau).max()


def test_a_scene_may_state_its_sample_regions():
    """`sampler=region` has cake's regions, as the paper; it is a choice for every scene."""
    cake = Pipeline(config.load(["scene=cake", "sampler=region", "device=cpu"])).sampler
    assert [r.size for r in cake.regions] == [700, 400]
    assert [r.start for r in cake.regions] == [0.0, 0.5]
    assert cake.regions[0].lower == cake.regions[1].lower == [0.45, 0.45, 0.0]
    (plain,) = Pipeline(config.load(["scene=cake", "sampler=random", "device=cpu"])).sampler.regions
    assert (plain.size, plain.lower) == (700, None)
    (whole,) = Pipeline(config.load(["scene=sand", "sampler=region", "device=cpu"])).sampler.regions
    assert (whole.size, whole.lower, whole.upper) == (150, [0.0] * 3, [1.0] * 3)
