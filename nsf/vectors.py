"""Numbers and vectors of a configuration: checked, and turned about an axis."""

import math
from collections.abc import Sequence
from numbers import Real

import numpy as np

from nsf.errors import ConfigError


def is_finite(value) -> bool:
    """Whether a value is a number that a float can hold."""
    try:
        return isinstance(value, Real) and not isinstance(value, bool) and math.isfinite(value)
    except OverflowError:  # a whole number of more than 308 digits
        return False


def spaced(count: int, most: int) -> np.ndarray:
    """At most `most` of the indices 0 … count − 1, evenly spread, the first and the last among them."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int))


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
        raise ConfigError(f"{key}={value} must be {kind}{limits}")
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
        raise ConfigError(f"{key}={value!r} must be text, and not empty")
    return value


def is_list(values) -> bool:
    """Whether values are several, of a yaml or of Python."""
    return isinstance(values, Sequence | np.ndarray) and not isinstance(values, str)


def numbers(key: str, values, unit: str = "", count: int | None = None) -> np.ndarray:
    """An array of `count` finite numbers, or of any number of them.

    Raises:
        ConfigError: quotes the key and the values.
    """
    finite = is_list(values) and all(map(is_finite, values))
    if not finite or count not in (None, len(values)):
        wanted = "a list of finite numbers" if count is None else f"{count} finite numbers"
        raise ConfigError(f"{key}={values}{' ' * bool(unit)}{unit} must be {wanted}")
    return np.array(values, float)


def vector(key: str, values, unit: str = "") -> tuple[float, float, float]:
    """Three finite numbers.

    Raises:
        ConfigError: quotes the key and the values.
    """
    return tuple(numbers(key, values, unit, 3).tolist())


def direction(key: str, values) -> np.ndarray:
    """The unit vector [3] along three numbers.

    Raises:
        ConfigError: they are not finite, or their length is zero or overflows; quotes the key and the values.
    """
    along = numbers(key, values, count=3)
    with np.errstate(over="ignore", under="ignore"):
        length = np.linalg.norm(along)
    if not 0.0 < length < math.inf:
        raise ConfigError(f"{key}={values} has no direction; give a vector of a length near 1")
    return along / length


def rotation(axis: np.ndarray, angle: float) -> np.ndarray:
    """Rotation matrix [3, 3] about a unit axis, right-handed.

    Args:
        axis: [3] unit vector.
        angle: [°].

    Source: Rodrigues' formula, R = I + sin θ K + 2 sin²(θ/2) K², K = axis ×.
    """
    x, y, z = axis
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    theta = math.radians(angle)
    return np.eye(3) + math.sin(theta) * K + 2.0 * math.sin(0.5 * theta) ** 2 * (K @ K)
