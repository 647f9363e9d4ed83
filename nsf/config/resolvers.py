"""Interpolations of a configuration: which there are, and their values.

A configuration may come from someone else. It refers to its own keys and calls the resolvers named here;
what it could learn of this machine through OmegaConf's and Hydra's other ones stays unread.
"""

import re
from collections.abc import Iterator
from typing import Any

from omegaconf import MISSING, DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from nsf.errors import ConfigError
from nsf.scalars import number, one_of

#: Resolvers that any key may call.
ALLOWED = ("scaled", "per", "turned", "oc.select")
#: Keys that may name a folder by the environment, and how.
_FOLDERS = {"report.folder", "point.folder"}
_FROM_ENVIRONMENT = re.compile(r"\$\{oc\.env:NSF_REPORTS,\w+\}[\w/-]*")
#: Every interpolation begins like this; in group 1 the resolver or the key, in 2 what ends it.
_BEGINNING = re.compile(r"\$\{\s*([^:{}$]*?)\s*([:{}$]|\Z)")
#: `oc.select` of a key that is written out.
_SELECTION = re.compile(r"\$\{\s*oc\.select\s*:\s*[\w.\[\]-]+\s*[,}]")
#: A reference to another key, by itself or through `oc.select`; leading dots count from where it stands.
_REFERENCE = re.compile(r"\$\{\s*(?:oc\.select\s*:\s*)?(\.*)([\w-]+(?:\.[\w-]+|\[\w+\])*)")
#: How OmegaConf says that a key refers to one that is not there.
_MISSING = re.compile(r"(?:Interpolation key '|Error trying to access )([\w.]+)")
_MOST = (
    20_000  # values of a whole configuration with those that it refers to; those of conf/ have some hundred
)


def scaled(table: DictConfig, *, _root_: DictConfig):
    """`${scaled:{small: a, paper: b}}`: the entry of the scale in force."""
    scale = _root_.scale
    if not isinstance(table, dict | DictConfig):
        raise ConfigError(f"${{scaled:{table}}} has no values by scale; give {{small: …, paper: …}}")
    return table[one_of("scale", scale, table)]


def per(count) -> float:
    """`${per:150}` = 1/150."""
    if not number("argument of ${per:…}", count):
        raise ConfigError(f"${{per:{count}}} divides by zero; give another number")
    return 1.0 / float(count)


def turned(values, axis, angle) -> list[float]:
    """`${turned:[1,0,0],[0,1,0],30}`: the vector turned by 30° about the axis, right-handed."""
    from nsf.vectors import direction, rotation, vector  # NumPy takes 0.1 s to load

    matrix = rotation(direction("axis of ${turned:…}", axis), number("angle of ${turned:…}", angle))
    return (matrix @ vector("vector of ${turned:…}", values)).tolist()


OmegaConf.register_new_resolver("scaled", scaled, replace=True)
OmegaConf.register_new_resolver("per", per, replace=True)
OmegaConf.register_new_resolver("turned", turned, replace=True)


def leaves(node: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Path and value of everything in a plain tree that is neither a mapping nor a list."""
    children = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else None
    if children is None:
        yield path, node
        return
    for key, child in children:
        yield from leaves(child, (*path, str(key)))


def resolved(config: DictConfig) -> Any:
    """The plain tree of a configuration, each interpolation replaced by its value.

    Raises:
        ConfigError: a value is missing, refers to nothing, or calls a resolver that is not allowed.
    """
    try:
        raw, open_values = OmegaConf.to_container(config), False
        for path, value in leaves(raw):
            _check(".".join(path), value)
            open_values |= isinstance(value, str) and ("${" in value or value == MISSING)
        if not open_values:  # most nodes that are built; a second walk would take as long
            return raw
        if _size(raw) > _MOST:
            raise ConfigError(
                f"the configuration has more than {_MOST} values, as keys refer to others; have fewer"
            )
        plain = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    except OmegaConfBaseException as error:
        # OmegaConf wraps what a resolver raises; its own words come first in the text.
        detail = re.sub(r"^\w*Error raised while resolving interpolation: ", "", str(error).splitlines()[0])
        if detail.startswith("Recursive interpolation"):
            detail = "it refers to itself, by way of other keys or not; give one of them a value"
        if detail.startswith("Missing mandatory value"):
            detail = "it has no value; set one"
        if missing := _MISSING.match(detail):
            detail = f"it refers to {missing[1]}, which is missing; give that a value"
        raise ConfigError(f"{error.full_key}: {detail}" if error.full_key else detail) from error
    for path, value in leaves(plain):
        if (
            isinstance(value, str) and "${" in value
        ):  # put together from pieces, it would be resolved next time
            raise ConfigError(f"{'.'.join(path)}={value} becomes an interpolation itself; write it out")
    return plain


def _check(key: str, value: Any) -> None:
    if not isinstance(value, str) or (key in _FOLDERS and _FROM_ENVIRONMENT.fullmatch(value)):
        return
    for beginning in _BEGINNING.finditer(value):
        name, end = beginning.groups()
        written_out = name != "oc.select" or _SELECTION.match(value, beginning.start())
        if end != "}" and not (end == ":" and name in ALLOWED and written_out):
            raise ConfigError(
                f"{key}: ${{{name}{end}…}} is refused; a value may refer to a key, as ${{scene.dx}}, "
                f"or call one of {', '.join(ALLOWED)}"
            )


def references(raw: Any) -> dict[tuple[str, ...], list[tuple[str, ...]]]:
    """Paths of the keys that each value of a tree refers to, by its path; interpolations were kept."""
    return {
        path: [_target(*match, path) for match in _REFERENCE.findall(value)]
        + [("scale",)] * ("scaled" in value)
        for path, value in leaves(raw)
        if isinstance(value, str) and "${" in value
    }


def following(config: DictConfig, key: str) -> list[tuple[str, ...]]:
    """Paths of the values of a configuration that may follow a key, directly or through others."""
    referring = references(OmegaConf.to_container(config))
    dependent, keys = [], [_target("", key, ())]
    while keys:
        reached = keys.pop()
        for path in list(referring):
            if any(reached[: len(target)] == target[: len(reached)] for target in referring[path]):
                del referring[path]
                dependent.append(path)
                keys.append(path)
    return dependent


def _target(dots: str, name: str, path: tuple[str, ...]) -> tuple[str, ...]:
    """The path that a reference leads to from where it stands."""
    return (path[: len(path) - len(dots)] if dots else ()) + tuple(re.findall(r"[\w-]+", name))


def _size(raw: Any) -> int:
    """How many values a tree has once every reference in it is replaced by what it refers to."""
    sizes: dict[tuple[str, ...], int] = {}

    def of(node: Any, path: tuple[str, ...]) -> int:
        if path not in sizes:
            sizes[path] = 1  # of one that refers to itself, which OmegaConf refuses
            if isinstance(node, dict | list):
                children = node.items() if isinstance(node, dict) else enumerate(node)
                sizes[path] += sum(of(child, (*path, str(key))) for key, child in children)
            elif isinstance(node, str):
                sizes[path] += sum(referred(*reference, path) for reference in _REFERENCE.findall(node))
        return sizes[path]

    def referred(dots: str, name: str, path: tuple[str, ...]) -> int:
        target, node = _target(dots, name, path), raw
        for part in target:
            try:
                node = node[int(part) if isinstance(node, list) else part]
            except (KeyError, IndexError, TypeError, ValueError):
                return 1
        return of(node, target)

    return of(raw, ())
