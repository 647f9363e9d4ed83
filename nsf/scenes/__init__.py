"""Scenes (paper section 6): one yaml each in `conf/scene`."""

from collections.abc import Sequence

from nsf import config as _config
from nsf.scenes.body import Body
from nsf.scenes.designs import Design, Grid, LatinHypercube, Sobol, Values
from nsf.scenes.parameters import Parameter
from nsf.scenes.programs import (
    GravityProgram,
    Keyframes,
    MotionProgram,
    RandomPress,
    RandomPush,
    RandomShake,
    RandomTilt,
)
from nsf.scenes.scene import Scene
from nsf.scenes.shapes import Ball, Box, Cylinder, Frame, Mesh, Ribbon, Shape, TentacleBall, mesh_or_ball
from nsf.scenes.weakness import Weakness

__all__ = [
    "Ball",
    "Body",
    "Box",
    "Cylinder",
    "Design",
    "Frame",
    "GravityProgram",
    "Grid",
    "Keyframes",
    "LatinHypercube",
    "Mesh",
    "MotionProgram",
    "Parameter",
    "RandomPress",
    "RandomPush",
    "RandomShake",
    "RandomTilt",
    "Ribbon",
    "Scene",
    "Shape",
    "Sobol",
    "TentacleBall",
    "Values",
    "Weakness",
    "load",
    "mesh_or_ball",
]


def load(name: str, overrides: Sequence[str] = ()) -> Scene:
    """Load a scene of `conf/scene` by name.

    Args:
        name: for example `sand`.
        overrides: Hydra overrides, for example `["scale=paper", "scene.dt=0.001"]`.

    Raises:
        ConfigError: unknown scene, key or value.
    """
    return Scene.from_config(_config.load([f"scene={name}", *overrides]))
