"""Values in one canonical form, and the hash of it."""

import hashlib
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from nsf.errors import ConfigError

_HASH_DIGITS = 12


def content_hash(content: Any) -> str:
    """First 12 hex digits of the sha256 of canonical JSON (sorted keys, 30.0 written as 30)."""
    text = json.dumps(_canonical(content), sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()[:_HASH_DIGITS]


def plain(value: Any, finite: bool = True, key: str = "config") -> Any:
    """The same value in what JSON and YAML can hold.

    Args:
        value: mappings, sequences, scalars, paths; also NumPy or torch ones.
        finite: refuse NaN and infinity; else they become None.
        key: name of the value, for messages.

    Raises:
        ConfigError: a value is of another kind, or not finite.
    """
    if isinstance(value, Mapping):
        return {str(name): plain(item, finite, f"{key}.{name}") for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item, finite, f"{key}[{i}]") for i, item in enumerate(value)]
    if isinstance(value, Path):
        return str(value)
    if hasattr(value, "tolist"):  # NumPy and torch
        return plain(value.tolist(), finite, key)
    if isinstance(value, float) and not math.isfinite(value):
        if finite:
            raise ConfigError(f"{key}={value} is not finite; give a finite number, or leave the key out")
        return None
    if value is None or isinstance(value, bool | int | float | str):
        return value
    raise ConfigError(
        f"{key}={value!r} is a {type(value).__name__}; use numbers, strings, lists and mappings"
    )


def _canonical(value: Any) -> Any:
    # As RFC 8785: 30 and 30.0 are one number, so that both spellings name one run.
    if isinstance(value, dict):
        return {name: _canonical(item) for name, item in value.items()}
    if isinstance(value, list):
        return [_canonical(item) for item in value]
    if isinstance(value, float) and value.is_integer() and abs(value) < 2**53:
        return int(value)
    return value
