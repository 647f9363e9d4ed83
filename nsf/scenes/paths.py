"""Key paths into a scene: `material.E`, `bodies.cube.velocity.0`, as configurations write them."""

from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass, replace
from typing import Any

from nsf.errors import NSFError
from nsf.vectors import is_list


def parts_of(key: str) -> tuple[str, ...]:
    """The parts of a key; the `scene.` that a configuration writes in front of a scene's own is left out."""
    parts = key.replace("[", ".").replace("]", "").split(".")
    return tuple(parts[1:] if parts[0] == "scene" else parts)


def value_at(node: Any, parts: Sequence[str]) -> Any:
    """The value at the end of a path.

    Raises:
        KeyError: there is nothing; has the part that is missing, and those in its place.
    """
    for part in parts:
        inside = _inside(node)
        if part not in inside:
            raise KeyError(part, tuple(inside))
        node = inside[part]
    return node


def _inside(node: Any) -> dict[str, Any]:
    """Values of a dataclass, a mapping or a list, by the part of a path that leads there."""
    if is_dataclass(node):
        return {field.name: getattr(node, field.name) for field in fields(node)}
    if isinstance(node, Mapping):
        return dict(node)
    return {str(at): inner for at, inner in enumerate(node)} if is_list(node) else {}


def with_value(node: Any, parts: Sequence[str], value: Any, where: str) -> Any:
    """A copy with another value at the end of a path that exists; all beside the path is shared.

    Args:
        node: a frozen dataclass, mapping or sequence.
        parts: of the path.
        value: new.
        where: the path to `node`, for messages.

    Raises:
        NSFError: a class on the way refuses the value; names its path.
    """
    if not parts:
        return value
    first, rest = parts[0], parts[1:]
    path = f"{where}.{first}"
    if isinstance(node, Mapping):
        return {**node, first: with_value(node[first], rest, value, path)}
    if is_list(node):
        at = int(first)
        return (*node[:at], with_value(node[at], rest, value, path), *node[at + 1 :])
    inner = with_value(getattr(node, first), rest, value, path)
    try:
        return replace(node, **{first: inner})
    except NSFError as error:
        text = str(error)
        raise type(error)(text if text.startswith(where) else f"{where}: {text}") from error
