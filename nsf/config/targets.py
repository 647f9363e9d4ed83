"""The classes that a `_target_` of a configuration may name, and the objects that are built from it.

A configuration is data, also where someone else wrote it: it chooses among the classes that a key expects, of
nsf and of packages that the user installed for it (`nsf.installed`), and gives them their values. All else is
refused before it is imported.
"""

import dataclasses
import difflib
import importlib
import inspect
import re
import typing
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import NoneType, UnionType
from typing import TYPE_CHECKING, Any, NamedTuple

from omegaconf import DictConfig

from nsf.code import arguments
from nsf.config.resolvers import resolved
from nsf.errors import ConfigError, NSFError, first_line, unknown
from nsf.installed import entry_point_of
from nsf.scalars import is_finite, shown

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint


class Kind(NamedTuple):
    """The kind of object that a key expects.

    Attributes:
        package: in which its classes lie; nothing else is imported.
        base: what they are derived from, or the protocol whose members they have.
        functions: of the package that may be named as well.
    """

    package: str
    base: str
    functions: tuple[str, ...] = ()


_MODEL = Kind("nsf.models", "nsf.models.Model")
_SHAPE = Kind("nsf.scenes", "nsf.scenes.Shape", ("nsf.scenes.mesh_or_ball",))

#: What each key expects; `*` stands for any name. A new group of conf/ is a line here.
KINDS = {
    "field": Kind("nsf.kinematics.fields", "nsf.kinematics.training.train.Field"),
    "integration": Kind("nsf.dynamics", "nsf.dynamics.Integration"),
    "material": Kind("nsf.mpm.materials", "nsf.mpm.materials.Material"),
    "model": _MODEL,
    "model.of.*": _MODEL,
    "projector": Kind("nsf.dynamics", "nsf.dynamics.projection.Projector"),
    "sampler": Kind("nsf.sampling", "nsf.sampling.Sampler"),
    "trainer": Kind("nsf.kinematics.training", "nsf.kinematics.training.schedules.Trainer"),
    "transfer": Kind("nsf.mpm", "nsf.mpm.Transfer"),
    "scene.design": Kind("nsf.scenes", "nsf.scenes.Design"),
    "scene.inclination": Kind("nsf.scenes", "nsf.scenes.Inclination"),
    "scene.walls": Kind("nsf.mpm", "nsf.mpm.DomainWalls"),
    "scene.colliders.*": Kind("nsf.mpm", "nsf.mpm.Collider"),
    "scene.colliders.*.motion": Kind("nsf.mpm", "nsf.mpm.Motion"),
    "scene.forcing.gravity.*": Kind("nsf.scenes", "nsf.scenes.GravityProgram"),
    "scene.forcing.colliders.*": Kind("nsf.scenes", "nsf.scenes.MotionProgram"),
    "scene.bodies.*": Kind("nsf.scenes", "nsf.scenes.Body"),
    "scene.bodies.*.shape": _SHAPE,
    "scene.bodies.*.weakness": Kind("nsf.scenes", "nsf.scenes.Weakness"),
    "scene.bodies.*.weakness.region": _SHAPE,
}
_NAME = re.compile(r"[A-Za-z]\w*(\.[A-Za-z]\w*)+", re.ASCII)
#: Types in words: one value, and several.
_WORDS = {
    int: ("a whole number", "whole numbers"),
    float: ("a number", "numbers"),
    bool: ("true or false", "true or false"),
    str: ("text", "texts"),
    dict: ("keys with values", "mappings of keys to values"),
    NoneType: ("null", "null"),
}
#: Types by their names in the text of a class.
_PLAIN = {"int": int, "float": float, "bool": bool, "str": str, "None": NoneType}
_PLAIN |= {f"Sequence[{name}]": Sequence[kind] for name, kind in _PLAIN.items()}


def check(node: Any, path: tuple[str, ...] = ()) -> None:
    """Refuse a `_target_` that its key does not expect, and values that its class does not take.

    A type is read from the text of the class; nothing is imported.

    Args:
        node: without interpolations.
        path: of its key.

    Raises:
        ConfigError: names the key, and the target or the value.
    """
    declared: dict[str, str] = {}
    if isinstance(node, dict):
        for key in node:
            if key == "_target_":
                _kind(path, node[key])
                declared = arguments(str(node[key])) or {}
            elif re.fullmatch("_.*_", str(key)):
                raise ConfigError(
                    f"{'.'.join((*path, str(key)))} is refused; of such keys there is only _target_"
                )
    children = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()
    for key, child in children:
        check(child, (*path, str(key)))
        kinds = [_PLAIN.get(name) for name in declared.get(key, "").split(" | ")]
        if None not in kinds:
            _check_type(".".join((*path, str(key))), child, typing.Union[*kinds])


def build(node: DictConfig | Mapping, where: str) -> Any:
    """The object that a node of a configuration stands for.

    Args:
        node: with a `_target_`, and the values that its class takes; these may be such nodes themselves.
        where: its key, which says what is expected.

    Raises:
        ConfigError: the target is missing or refused, a key is misspelt or missing, or the class refuses a
            value; names the node.
    """
    path = tuple(where.split("."))
    plain = resolved(node) if isinstance(node, DictConfig) else node
    check(plain, path)
    if not isinstance(plain, dict) or "_target_" not in plain:
        kind = kind_at(path)
        raise ConfigError(f"{where} names no class; give it a _target_: {kind.package if kind else 'nsf'}.…")
    return _built(plain, path)


def build_all(nodes: Any, where: str) -> dict[str, Any]:
    """The objects of a mapping from names to nodes.

    Raises:
        ConfigError: there is no such mapping; and as for `build`.
    """
    if not isinstance(nodes, Mapping):
        raise ConfigError(f"{where}={shown(nodes)} must map names to nodes; {{}} is none")
    if dotted := [name for name in nodes if "." in str(name)]:
        raise ConfigError(f"{where} has the name {dotted[0]!r}; leave the dot out, which parts keys")
    return {str(name): build(node, f"{where}.{name}") for name, node in nodes.items()}


def filled(made_of: Any, values: Mapping[str, Any], where: str) -> Any:
    """An object of a class, made of plain values.

    Args:
        made_of: the class, or a function.
        values: its arguments by name.
        where: key that they come from.

    Raises:
        ConfigError: a key is unknown or missing, or a value refused; names it.
    """
    parameters = inspect.signature(made_of).parameters
    for key in values:
        if key not in parameters:
            raise ConfigError(unknown(f"{where}.{key}", [f"{where}.{name}" for name in parameters]))
    for name, parameter in parameters.items():
        if name not in values and parameter.default is parameter.empty:
            raise ConfigError(f"{where}.{name} is missing; give it a value")
    hints = _hints(made_of)
    for name, value in values.items():
        _check_type(f"{where}.{name}", value, hints.get(name))
        if not _all_finite(value):
            raise ConfigError(f"{where}.{name}={value} must be finite")
    try:
        return made_of(**values)
    except NSFError as error:
        raise type(error)(str(error) if str(error).startswith(where) else f"{where}: {error}") from error
    except Exception as error:
        raise ConfigError(f"{where}: {first_line(error)}") from error


def _built(node: Any, path: tuple[str, ...]) -> Any:
    if isinstance(node, list):
        return [_built(child, (*path, str(at))) for at, child in enumerate(node)]
    if not isinstance(node, dict):
        return node
    values = {key: _built(child, (*path, str(key))) for key, child in node.items() if key != "_target_"}
    if "_target_" not in node:
        return values
    return filled(named_class(node["_target_"], path), values, ".".join(path))


def kind_at(path: tuple[str, ...]) -> Kind | None:
    """The kind of which a key expects a `_target_`; None where nothing is built from it."""
    for key, kind in KINDS.items():
        parts = key.split(".")
        if len(parts) == len(path) and all(map(lambda part, name: part in ("*", name), parts, path)):
            return kind
    return None


def _kind(path: tuple[str, ...], target: Any) -> Kind:
    """The kind that a key expects, if it is where a target could lie."""
    kind = kind_at(path)
    refused = f"{'.'.join(path) or 'the configuration'}: _target_: {target} is refused; "
    if kind is None:
        raise ConfigError(refused + "nothing is built from this key")
    if not (
        _NAME.fullmatch(str(target)) and (target.startswith(f"{kind.package}.") or _is_installed(target))
    ):
        module = Path(str(target).partition(".")[0])
        there = module.is_dir() or module.with_suffix(".py").is_file()
        here = there and Path("pyproject.toml").is_file()
        install = "; pip install -e . installs that of this folder" if here else ""
        raise ConfigError(f"{refused}name a {_noun(kind)} {_homes(kind)}{install}")
    return kind


def _is_installed(target: str) -> bool:
    """Whether a class is of a package that the user installed for nsf."""
    return not target.startswith("nsf.") and entry_point_of(target) is not None


def _noun(kind: Kind) -> str:
    return kind.base.rpartition(".")[2]


def _homes(kind: Kind) -> str:
    return f"of {kind.package}, or of an installed package that declares the entry point group nsf"


def named_class(target: str, path: tuple[str, ...]) -> Any:
    """The class, or the function, that a target names.

    Args:
        target: its dotted name.
        path: of the key, which says what is expected.

    Raises:
        ConfigError: there is no such class, or it is of another kind, or abstract.
    """
    kind, where = _kind(path, target), ".".join(path)
    named = _imported(target, where)
    if target in kind.functions:
        return named
    module, _, name = kind.base.rpartition(".")
    base = getattr(importlib.import_module(module), name)
    if not (inspect.isclass(named) and _is_a(named, base)):
        raise ConfigError(
            f"{where}: _target_: {target} is no {_noun(kind)}{_lacking(named, base)}; name one {_homes(kind)}"
        )
    if inspect.isabstract(named):
        missing = ", ".join(sorted(named.__abstractmethods__))
        raise ConfigError(
            f"{where}: _target_: {target} is abstract; define {missing}, or name a class that does"
        )
    return named


def _imported(target: str, where: str) -> Any:
    """The object of a dotted name; an error of the user's module is one line that names its entry point."""
    module, _, name = target.rpartition(".")
    point = None if target.startswith("nsf.") else entry_point_of(target)
    try:
        imported = importlib.import_module(module)
    except Exception as error:
        if point is None and isinstance(error, ImportError):
            raise ConfigError(f"{where}: _target_: {target} does not exist ({error})") from error
        raise _broken(target, where, point, error) from error
    if not hasattr(imported, name):
        near = difflib.get_close_matches(name, getattr(imported, "__all__", dir(imported)), n=1)
        remedy = f"did you mean {module}.{near[0]}?" if near else f"name a class of {module}"
        raise ConfigError(f"{where}: _target_: {target} does not exist; {remedy}")
    return getattr(imported, name)


def _broken(target: str, where: str, point: "EntryPoint", error: Exception) -> ConfigError:
    return ConfigError(
        f"{where}: _target_: {target} cannot be imported, {type(error).__name__}: {first_line(error)}; mend "
        f"{point.module}, the entry point {point.name!r} of {point.dist.name}"
    )


def _is_a(named: type, base: type) -> bool:
    if not getattr(base, "_is_protocol", False):
        return issubclass(named, base)
    name = f"{named.__module__}.{named.__name__}"
    return (name.startswith("nsf.") or _is_installed(name)) and members(base) <= _members(named)


def _lacking(cls: Any, protocol: type) -> str:
    """Parts of a protocol that a user's class lacks, as the end of a sentence."""
    if not (inspect.isclass(cls) and getattr(protocol, "_is_protocol", False)):
        return ""
    if missing := sorted(members(protocol) - _members(cls)):
        return f", which has {', '.join(missing)} as well"
    return ""


def _members(cls: type) -> set[str]:
    fields = {field.name for field in dataclasses.fields(cls)} if dataclasses.is_dataclass(cls) else set()
    return fields | set(dir(cls))


def members(protocol: type) -> set[str]:
    """Names of the attributes and methods that a protocol asks for."""
    return {name for name in {*vars(protocol), *protocol.__annotations__} if not name.startswith("_")}


def _hints(made_of: Any) -> dict[str, Any]:
    try:
        return typing.get_type_hints(made_of)
    except NameError:  # one that is imported for type checkers alone
        return {}


def _check_type(key: str, value: Any, hint: Any) -> None:
    if not _fits(value, hint):
        raise ConfigError(f"{key}={shown(value)} must be {_in_words(hint)}")


def _fits(value: Any, hint: Any) -> bool:
    """Whether a plain value is of an annotated type; of types not known here, the class itself says."""
    origin, inner = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, UnionType):
        return any(_fits(value, kind) for kind in inner)
    if origin is Sequence:
        return isinstance(value, list) and all(_fits(item, inner[0]) for item in value)
    return hint not in _WORDS or type(value) is hint or (hint is float and type(value) is int)


def _in_words(hint: Any, several: bool = False) -> str:
    """A type in words."""
    origin, inner = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, UnionType):
        return " or ".join(_in_words(kind, several) for kind in inner)
    if origin is Sequence:
        return ("lists of " if several else "a list of ") + _in_words(inner[0], several=True)
    return _WORDS[hint][several] if hint in _WORDS else hint.__name__


def _all_finite(value: Any) -> bool:
    if isinstance(value, list):
        return all(map(_all_finite, value))
    return isinstance(value, bool) or not isinstance(value, int | float) or is_finite(value)
