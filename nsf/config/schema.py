"""Keys that something reads: all others are refused, with the nearest one that there is.

Read are the keys of `conf/`, those that the class of a `_target_` takes, and any key that a value refers to,
as `${scene.spatula.angle}`.
"""

from collections.abc import Iterator, Mapping
from functools import cache
from typing import Any

import yaml

from nsf.code import arguments
from nsf.config.documents import LOADER, text_of
from nsf.config.resolvers import references
from nsf.config.targets import kind_at, named_class
from nsf.errors import ConfigError, unknown
from nsf.paths import CONF

Keys = tuple[str, ...]
#: Mappings whose readers refuse what they do not take.
_CHECKED_BY_READER = {("scene", "parameters"), ("deploy", "changes")}
#: Keys whose classes are imported without torch.
_LIGHT = ("scene", "material", "transfer")


def refuse_unread(raw: Mapping[str, Any], plain: Mapping[str, Any]) -> None:
    """Refuse keys that nothing reads.

    Args:
        raw: containers of a configuration, its interpolations kept.
        plain: the same, resolved.

    Raises:
        ConfigError: names each such key, and the nearest one that there is.
    """
    referred = {target for targets in references(raw).values() for target in targets}
    alone = "scene" not in plain and {"point", "path"} & plain.keys()
    stock = stock_keys("point" if alone else "config")
    readable: list[Keys] = []
    if unread := list(_unread(plain, stock, (), referred, readable)):
        takers = [_class_of(plain, keys) for keys in unread]
        for keys, taker in zip(unread, takers, strict=True):
            if taker and keys[0] in _LIGHT:
                named_class(taker, keys[:-1])  # refused first where it is of another kind
        names = [".".join(keys) for keys in readable]
        users = ["" if taker.startswith("nsf.") else taker for taker in takers]
        messages = [unknown(".".join(keys), names, taker=of) for keys, of in zip(unread, users, strict=True)]
        raise ConfigError("; ".join(messages).replace("?; ", "? "))


def _class_of(plain: Mapping[str, Any], keys: Keys) -> str:
    """The class that is built from the node of a key; empty where there is none."""
    for name in keys[:-1]:
        plain = next(child for key, child in plain.items() if str(key) == name)
    return str(plain.get("_target_", ""))


def _unread(
    node: Mapping[str, Any], stock: Mapping[str, Any], at: Keys, referred: set[Keys], readable: list[Keys]
) -> Iterator[Keys]:
    """Keys below a node that nothing reads; `readable` gets those that are, or would be, read.

    Args:
        node: plain.
        stock: the keys that `conf/` has below the same key.
        at: its key.
        referred: keys that some value refers to.
    """
    if kind_at(at) and "_target_" not in node:
        return  # which is refused where it is built
    named = kind_at((*at, "*")) is not None  # as scene.bodies, a mapping from names to objects
    taken = set(stock)
    if "_target_" in node:
        taken = arguments(str(node["_target_"]))
    readable += [(*at, str(name)) for name in sorted(taken or ())]
    for name, child in node.items():
        below = (*at, str(name))
        inner = {} if "_target_" in node else stock.get(name, {})
        if not (named or taken is None or name in taken or name == "_target_"):
            if not any(one[: len(below)] == below[: len(one)] for one in referred):
                yield below
                continue
            readable.append(below)
        elif not (inner or kind_at(below) or kind_at((*below, "*"))):
            continue  # a value, which may be a mapping
        if isinstance(child, Mapping) and below not in _CHECKED_BY_READER:
            yield from _unread(child, inner, below, referred, readable)


@cache
def stock_keys(primary: str) -> dict[str, Any]:
    """The keys of `conf/PRIMARY.yaml`, its groups and, below `scene`, every scene there is, as a tree.

    A key that a scene of `conf/` has for itself, as `scene.spatula`, is one that its own values refer to.
    """
    content = _content(f"{primary}.yaml")
    groups = [group for default in content.pop("defaults") if default != "_self_" for group in default]
    tree = {group: {} for group in groups} | _tree(content)
    if "scene" in groups:
        tree["scene"] = {}
        for path in sorted((CONF / "scene").glob("*.yaml")):
            file = _content(f"scene/{path.name}")
            referred = {key[:2] for keys in references(file).values() for key in keys}
            keys = _tree(file.get("scene", {})).items()
            _add(tree["scene"], {key: below for key, below in keys if ("scene", key) not in referred})
    return tree


def _content(name: str) -> dict[str, Any]:
    return yaml.load(text_of(CONF / name), LOADER)


def _tree(node: Any) -> dict[str, Any]:
    return {key: _tree(child) for key, child in node.items()} if isinstance(node, dict) else {}


def _add(tree: dict[str, Any], other: Mapping[str, Any]) -> None:
    for key, child in other.items():
        _add(tree.setdefault(key, {}), child)
