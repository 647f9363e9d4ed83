"""Scenes from configurations: the one place where keys become a scene's values."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
from omegaconf import DictConfig, OmegaConf

from nsf.config.composing import resolve
from nsf.config.keys import naming_the_missing, replaced, section
from nsf.config.loading import load
from nsf.config.resolvers import following
from nsf.config.targets import build, build_all, filled
from nsf.errors import ConfigError
from nsf.scalars import text
from nsf.scenes import Design, Parameter, Programs, Scene
from nsf.scenes.identity import plain_scene, plain_value

#: Keys of a configuration's scene that say nothing of its physics.
NOT_PHYSICS = ("name", "title", "parameters", "design", "paper")
_REQUIRED, _OPTIONAL = ("name", "size", "dx", "dt", "steps", "gravity"), ("program",)
_PHYSICS = re.compile(
    r"(material|transfer|scene\.(dx|dt|steps|size|gravity|inclination|bodies|colliders|walls|forcing))\b"
)


def load_scene(name: str, overrides: Sequence[str] = ()) -> Scene:
    """A scene of `conf/scene` by name.

    Args:
        name: for example `sand`.
        overrides: Hydra overrides, for example `["scale=paper", "scene.dt=0.001"]`.

    Raises:
        ConfigError: unknown scene, key or value.
    """
    return scene_of(load([f"scene={name}", *overrides]))


def scene_of(config: DictConfig, whole: DictConfig | None = None) -> Scene:
    """The scene of a configuration with `scene`, `material` and `transfer`.

    Args:
        config: with its interpolations, where it has any.
        whole: the same resolved, where it is at hand.

    Raises:
        ConfigError: a key is unknown, a value refused, or a key refers to one that a parameter replaces.
    """
    with naming_the_missing():
        whole = resolve(config) if whole is None else whole
        for name, parameter in _parameters(section(whole, "scene.parameters")).items():
            _refuse_followers(config, name, parameter.key)
        scene = _built(whole, build(section(whole, "scene.design"), "scene.design"))
        _ = scene.split  # refuses cases that no run could have
        return scene


def _built(whole: DictConfig, design: Design | None) -> Scene:
    """The scene of a resolved configuration."""
    s = section(whole, "scene")
    if "title" in s:
        text("scene.title", s.title)
    values = {key: _plain(s[key]) for key in (*_REQUIRED, *_OPTIONAL) if key in s or key in _REQUIRED}
    if s.get("inclination") is not None:
        values["inclination"] = build(s.inclination, "scene.inclination")
    return Scene(
        **values,
        bodies=build_all(s.bodies, "scene.bodies"),
        colliders=build_all(s.get("colliders", {}), "scene.colliders"),
        walls=build(s.walls, "scene.walls"),
        material=build(whole.material, "material"),
        transfer=build(whole.transfer, "transfer"),
        forcing=_programs(s.get("forcing") or {}),
        parameters=_parameters(section(whole, "scene.parameters")),
        design=design,
    )


def config_of(scene: Scene, overrides: Sequence[str] = ()) -> DictConfig:
    """The configuration of the whole chain of a scene that was written in Python.

    Args:
        scene: whose classes are of this package, as a configuration names no others.
        overrides: Hydra overrides of all keys but the scene's; unset ones are as for `scene=sand`.

    Raises:
        ConfigError: see `load`.
    """
    config = load(["scene=sand", *overrides])
    plain = plain_scene(scene)
    plain["scene"] |= {
        "name": scene.name,
        "title": scene.name,
        "parameters": {name: asdict(parameter) for name, parameter in scene.parameters.items()},
        "design": plain_value(scene.design),
    }
    for key, value in plain.items():
        config[key] = value
    return config


def changed_scene(config: DictConfig, scene: Scene, changes: Mapping[str, Any]) -> Scene:
    """The scene of a configuration with other values of some keys, and the same particles at rest and steps.

    A manifold of one can be deployed on the other: the fields are functions of the particles' X, and a latent
    vector steps by Δt on the grid.

    Args:
        config: with its interpolations.
        scene: of the configuration.
        changes: values by dotted key of the scene, its material or its transfer.

    Raises:
        ConfigError: a key is unknown, a problem parameter's, or one that changes X, the grid or the steps; a
            value is refused.
    """
    if keys := [p.key for p in scene.parameters.values() if p.key in changes]:
        raise ConfigError(f"{keys[0]} is a problem parameter; set scene.design.test")
    for key in changes:
        part, *names = key.split(".")
        if part not in ("scene", "material", "transfer") or not names or names[0] in NOT_PHYSICS:
            raise ConfigError(f"unknown key {key!r}; give a dotted key of the physics, as scene.gravity")
    changed = scene_of(replaced(config, changes))
    same = {
        "particles": np.array_equal(changed.particles().X, scene.particles().X),
        "grid nodes": (changed.grid, changed.size) == (scene.grid, scene.size),
        "time steps": (changed.dt, changed.steps) == (scene.dt, scene.steps),
    }
    if other := [name for name, equal in same.items() if not equal]:
        raise ConfigError(
            f"{', '.join(changes)} gives other {', '.join(other)} than the manifold is trained on; "
            f"set it for the whole chain, {next(iter(changes))}=…"
        )
    return changed


def _plain(value: Any) -> Any:
    return OmegaConf.to_container(value) if OmegaConf.is_config(value) else value


def _parameters(nodes: DictConfig) -> dict[str, Parameter]:
    """The parameters by name; null in place of one leaves out that of a scene below."""
    where, named = "scene.parameters", OmegaConf.to_container(nodes)
    named = {name: node for name, node in named.items() if node is not None}
    for name, node in named.items():
        if not isinstance(node, Mapping):
            raise ConfigError(
                f"{where}.{name}={node} must map keys to values, as {{key: material.E, unit: Pa}}"
            )
    if not named:
        raise ConfigError(f"{where}={nodes} leaves nothing to vary; give a name with its key and unit")
    return {name: filled(Parameter, node, f"{where}.{name}") for name, node in named.items()}


def _refuse_followers(config: DictConfig, name: str, key: str) -> None:
    """A case replaces a value of the scene: a key that refers to it would stay as it is."""
    followers = [".".join(path) for path in following(config, key)] if key else []
    if stale := [path for path in followers if _PHYSICS.match(path)]:
        raise ConfigError(
            f"{stale[0]} refers to {key}, which scene.parameters.{name} replaces, and would not follow it; "
            f"set scene.parameters.{name}.key={stale[0]}, or use scene.inclination.angle or a motion's tilt "
            "where one number turns several vectors"
        )


def _programs(node: Any) -> Programs:
    """The programs of a scene's configuration."""
    if not isinstance(node, Mapping) or not set(node) <= {"gravity", "colliders"}:
        raise ConfigError(
            f"scene.forcing={node} must have the keys gravity and colliders, each with programs by name"
        )
    return Programs(
        build_all(node.get("gravity", {}), "scene.forcing.gravity"),
        build_all(node.get("colliders", {}), "scene.forcing.colliders"),
    )
