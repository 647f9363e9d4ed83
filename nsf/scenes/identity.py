"""Scenes as plain containers: what names their runs, and what makes two scenes the same physics."""

from collections.abc import Mapping
from dataclasses import MISSING, fields, is_dataclass
from typing import Any

from nsf.canonical import content_hash
from nsf.vectors import is_list

#: Attributes of a scene that its simulation does not depend on.
_NOT_PHYSICS = ("name", "parameters", "design")
#: What a learned model takes as input.
_INPUT = ("gravity", "inclination", "forcing", "program")


def plain_value(value: Any) -> Any:
    """A frozen dataclass as containers and numbers, as a configuration has it; defaults are left out."""
    if is_dataclass(value):
        named = {"_target_": f"{type(value).__module__}.{type(value).__qualname__}"}
        return named | _attributes(value)
    if isinstance(value, Mapping):
        return {str(name): plain_value(item) for name, item in value.items()}
    if is_list(value):
        return [plain_value(item) for item in value]
    return value


def _attributes(value: Any) -> dict[str, Any]:
    """The attributes that differ from their defaults, by name."""
    found = {}
    for own in fields(value):
        default = own.default_factory() if own.default_factory is not MISSING else own.default
        plain = plain_value(getattr(value, own.name))
        if own.init and (default is MISSING or plain != plain_value(default)):
            found[own.name] = plain
    return found


def plain_scene(scene) -> dict[str, Any]:
    """The keys `scene`, `material` and `transfer` of a configuration that gives the physics of a scene.

    Args:
        scene: a `nsf.scenes.Scene`.
    """
    content = {own.name: plain_value(getattr(scene, own.name)) for own in fields(scene)}
    apart = {name: plain_value(getattr(scene, name)) for name in ("material", "transfer")}
    left_out = (*_NOT_PHYSICS, *apart)
    content = {name: value for name, value in content.items() if name not in left_out and value is not None}
    content["forcing"].pop("_target_")  # a mapping of two mappings in a configuration
    return {"scene": content} | apart


def physics_hash(scene) -> str:
    """Hash of a scene's physics but for its forcing, initial velocities and the values of its parameters."""
    content = plain_scene(scene)
    for parameter in scene.parameters.values():
        node: Any = content if parameter.path[0] in content else content["scene"]
        for part in parameter.path[:-1]:
            node = node[int(part)] if isinstance(node, list) else node.get(part, {})
        if isinstance(node, dict):
            node.pop(parameter.path[-1], None)
    content["scene"] = {name: value for name, value in content["scene"].items() if name not in _INPUT}
    for body in content["scene"]["bodies"].values():
        body.pop("velocity", None)
    return content_hash(content)
