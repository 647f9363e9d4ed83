"""Schemas of files: of which kind each value is, checked before anything uses it.

A schema is a type (`float` takes whole numbers too, never a truth value); `None`; a `Number`; a pattern, for
texts that fit it whole; a tuple, of schemas of which one fits; a list of one schema, for lists of such; or a
mapping from keys to schemas, for mappings that have these keys and any others. A key in `Maybe` may be
absent, and the key `...` has the schema of all keys that are not named.
"""

import json
import math
import re
import reprlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nsf.errors import SchemaError, first_line

_DEEPEST = 32  # lists and mappings inside each other
_WIDEST = 2**63  # whole numbers below it
_NAMES = {dict: "keys with values", list: "a list", str: "text", bool: "true or false", None: "null"}


@dataclass(frozen=True)
class Number:
    """Numbers from `least` to `most`; `whole` ones alone."""

    least: float = -math.inf
    most: float = math.inf
    whole: bool = False

    def __str__(self):
        kind = "a whole number" if self.whole else "a number"
        if self.most < math.inf:
            return f"{kind} from {self.least:g} to {self.most:g}"
        return f"{kind} of at least {self.least:g}" if self.least > -math.inf else kind


@dataclass(frozen=True)
class Maybe:
    """A key that may be absent."""

    key: str


def check(value: Any, schema: Any, name: str = "it") -> None:
    """Refuse a value of another kind than its schema says.

    Args:
        value: plain containers.
        schema: as this module describes them.
        name: of the value, for the message.

    Raises:
        SchemaError: names the first value that does not fit, and what it must be.
    """
    kind = next((one for one in _alternatives(schema) if _is(value, one)), ...)
    if kind is ...:
        wanted = " or ".join(map(_named, _alternatives(schema)))
        raise SchemaError(f"{name}={reprlib.repr(value)} must be {wanted}")
    if isinstance(kind, list):
        for place, item in enumerate(value):
            check(item, kind[0], f"{name}[{place}]")
    if isinstance(kind, Mapping):
        rest, head = dict(value), "" if name == "it" else f"{name}."
        for key, inner in kind.items():
            text = key.key if isinstance(key, Maybe) else key
            if text in rest:
                check(rest.pop(text), inner, f"{head}{text}")
            elif key is not ... and not isinstance(key, Maybe):
                raise SchemaError(f"{name} lacks {text}")
        for key, item in rest.items() if ... in kind else ():
            check(item, kind[...], f"{head}{key}")


def parse(text: str, name: str, schema: Any) -> Any:
    """The value of a JSON text, of the kind that its schema says.

    Args:
        text: whole.
        name: of its file, for messages; schema: as of `check`.

    Raises:
        SchemaError: it is no JSON, holds a value that no writer leaves, or does not fit its schema.
    """
    try:
        value = json.loads(text, parse_constant=_no_constant)
    except (ValueError, RecursionError) as error:
        raise SchemaError(f"{name} is no JSON: {first_line(error)}") from error
    if is_strange(value):
        raise SchemaError(
            f"{name} holds a number that is not finite, broken text, or more than {_DEEPEST} levels"
        )
    try:
        check(value, schema)
    except SchemaError as error:
        raise SchemaError(f"{name}: {error}") from error
    return value


def read(path: Path, schema: Any, most: int = 2**24) -> Any:
    """The value of a JSON file, of the kind that its schema says.

    Args:
        path: of the file; schema: as of `check`; most: [byte] that it may have.

    Raises:
        FileNotFoundError: there is none.
        SchemaError: it is larger, is not UTF-8, or as of `parse`; names it without its folder.
    """
    return parse(read_text(path, most), path.name, schema)


def read_text(path: Path, most: int) -> str:
    """The text of a file of at most some bytes.

    Raises:
        FileNotFoundError: there is none.
        SchemaError: it has more, cannot be read or is not UTF-8; names it without its folder.
    """
    try:
        with path.open("rb") as file:
            content = file.read(most + 1)
    except (FileNotFoundError, NotADirectoryError):
        raise
    except OSError as error:
        raise SchemaError(f"{path.name} cannot be read: {error.strerror}") from error
    if len(content) > most:
        raise SchemaError(f"{path.name} has more than {most:,} bytes")
    try:
        return content.decode()
    except UnicodeDecodeError as error:
        raise SchemaError(f"{path.name} is not UTF-8") from error


def is_strange(value: Any, depth: int = 0) -> bool:
    """Whether a tree is too deep for its readers, or a leaf cannot be shown or written."""
    if isinstance(value, dict | list):
        children = [*value, *value.values()] if isinstance(value, dict) else value
        return depth == _DEEPEST or any(is_strange(child, depth + 1) for child in children)
    if isinstance(value, str):
        return not value.isascii() and any("\ud800" <= c <= "\udfff" for c in value)
    if isinstance(value, float):
        return not math.isfinite(value)
    return isinstance(value, int) and abs(value) >= _WIDEST


def _alternatives(schema: Any) -> tuple:
    return schema if isinstance(schema, tuple) else (schema,)


def _is(value: Any, kind: Any) -> bool:
    """Whether a value is of one kind, but for what is inside of a list or a mapping."""
    match kind:
        case None:
            return value is None
        case re.Pattern():
            return isinstance(value, str) and kind.fullmatch(value) is not None
        case Number():
            return _is(value, int if kind.whole else float) and kind.least <= value <= kind.most
        case list() | Mapping():
            return isinstance(value, list if isinstance(kind, list) else Mapping)
    if kind in (int, float):
        return type(value) is int or (kind is float and type(value) is float)
    return isinstance(value, kind)


def _named(kind: Any) -> str:
    if isinstance(kind, re.Pattern):
        return f"text as {kind.pattern}"
    if isinstance(kind, Number):
        return str(kind)
    kind = list if isinstance(kind, list) else dict if isinstance(kind, Mapping) else kind
    return _NAMES.get(kind) or str(Number(whole=kind is int))


def _no_constant(name: str) -> None:
    raise ValueError(f"{name} is no number of JSON")
