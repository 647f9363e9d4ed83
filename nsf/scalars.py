"""Numbers and texts of a configuration, checked; loads no NumPy, so that a refusal is fast."""

import math
from collections.abc import Iterable
from numbers import Real
from typing import Any

from nsf.errors import ConfigError


def shown(value) -> str:
    """A value as a configuration writes it."""
    return "null" if value is None else str(value)


def is_finite(value) -> bool:
    """Whether a value is a number that a float can hold."""
    try:
        return isinstance(value, Real) and not isinstance(value, bool) and math.isfinite(value)
    except OverflowError:  # a whole number of more than 308 digits
        return False


#: Steps, particles and the like are counted in 32 bits on a device.
MOST_WHOLE = 2**31 - 1


def number(
    key: str, value, least: float = -math.inf, whole: bool = False, most: float = math.inf
) -> float | int:
    """A finite number of at least `least` and at most `most`; a whole one fits into 32 bits, but for a seed.

    Raises:
        ConfigError: quotes the key and the value.
    """
    of_kind = isinstance(value, int if whole else int | float) and is_finite(value)
    if whole and of_kind and value > MOST_WHOLE and not key.endswith("seed"):
        raise ConfigError(f"{key}={value} must be a whole number of at most {MOST_WHOLE}")
    if not (of_kind and least <= value <= most):
        kind = "a whole number" if whole else "a finite number"
        above = f" of at least {least:g}" if least > -math.inf else ""
        limits = above if most == math.inf else f" from {least:g} to {most:g}"
        raise ConfigError(f"{key}={shown(value)} must be {kind}{limits}")
    return value


def length(key: str, value) -> float:
    """A positive length [m].

    Raises:
        ConfigError: quotes the key and the value.
    """
    if not number(key, value) > 0:
        raise ConfigError(f"{key}={value} m must be positive")
    return float(value)


def text(key: str, value) -> str:
    """A text that is not empty.

    Raises:
        ConfigError: quotes the key and the value.
    """
    if not isinstance(value, str) or not value.strip():
        raise ConfigError(f"{key}={shown(value)} must be text, and not empty")
    return value


def one_of(key: str, value: Any, options: Iterable) -> Any:
    """A value that is one of several.

    Raises:
        ConfigError: quotes the key and the value, and names the others.
    """
    options = list(options)
    if not any(value == option and type(value) is type(option) for option in options):
        if not options:
            raise ConfigError(f"{key}={shown(value)} is unknown, with nothing to choose; leave it out")
        *names, last = [str(o).lower() if isinstance(o, bool) else shown(o) for o in options]
        choices = f"{', '.join(names)} or {last}" if names else last
        raise ConfigError(f"{key}={shown(value)} is unknown; choose {choices}")
    return value
