"""Words of a command, `key=value`, each read by what its key takes."""

import math
import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from nsf.errors import ConfigError

NUMBER = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
#: Reads the text of a key.
Reader = Callable[[str, str], Any]


def check(command: str, words: Sequence[str]) -> None:
    """Refuse a word that is no `key=value`.

    Raises:
        ConfigError: names the word.
    """
    if wrong := [word for word in words if word.startswith("-") or "=" not in word]:
        raise ConfigError(f"{wrong[0]!r} is not key=value; see `nsf {command} --help`")


def pairs(command: str, words: Sequence[str]) -> dict[str, str]:
    """Texts by key.

    Raises:
        ConfigError: a word is no pair, or a key stands twice.
    """
    check(command, words)
    keys = [word.split("=", 1)[0] for word in words]
    if twice := [key for key in keys if keys.count(key) > 1]:
        raise ConfigError(f"{twice[0]}= is given twice; give it once")
    return dict(word.split("=", 1) for word in words)


def values(command: str, words: Sequence[str], readers: Mapping[str, Reader]) -> dict[str, Any]:
    """Values by key.

    Raises:
        ConfigError: as `pairs`; or a key has no reader, or its reader refuses the text.
    """
    texts = pairs(command, words)
    if unknown := [key for key in texts if key not in readers]:
        keys = " and ".join(f"{key}=" for key in readers)
        raise ConfigError(f"nsf {command} has no key {unknown[0]!r}; it takes {keys}")
    return {key: readers[key](key, value) for key, value in texts.items()}


def text(key: str, value: str) -> str:
    """The text itself."""
    return value


def flag(key: str, value: str) -> bool:
    """`true` or `false`."""
    if value not in ("true", "false"):
        raise ConfigError(f"{key}={value} must be true or false")
    return value == "true"


def number(key: str, value: str) -> float:
    """A decimal number."""
    if not (re.fullmatch(NUMBER, value) and math.isfinite(float(value))):
        raise ConfigError(f"{key}={value} is no number that a computer holds")
    return float(value)


def positive(key: str, value: str) -> float:
    """A decimal number above 0."""
    if (read := number(key, value)) <= 0.0:
        raise ConfigError(f"{key}={value} must be positive")
    return read


def whole(least: int = 1, most: int = 10_000_000) -> Reader:
    """Reads a whole number from `least` to `most`."""

    def read(key: str, value: str) -> int:
        if not (re.fullmatch(r"\d{1,9}", value) and least <= int(value) <= most):
            raise ConfigError(f"{key}={value} must be a whole number from {least} to {most}")
        return int(value)

    return read
