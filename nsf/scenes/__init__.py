"""Scenes (paper section 6): one yaml each in `conf/scene`."""

from collections.abc import Sequence

from nsf import config as _config
from nsf.scenes.geometry import Box, Cylinder, Shape
from nsf.scenes.scene import Body, ParameterRange, Scene

__all__ = ["Body", "Box", "Cylinder", "ParameterRange", "Scene", "Shape", "load"]


def load(name: str, overrides: Sequence[str] = ()) -> Scene:
    """Load a scene of `conf/scene` by name.

    Args:
        name: for example `sand`.
        overrides: Hydra overrides, for example `["scale=paper", "scene.dt=0.001"]`.

    Raises:
        ConfigError: unknown scene, key or value.
    """
    return Scene.from_config(_config.load([f"scene={name}", *overrides]))
