"""Vectors of a configuration: checked, and turned about an axis."""

import math
from collections.abc import Sequence

import numpy as np

from nsf.errors import ConfigError
from nsf.scalars import is_finite, shown


def spaced(count: int, most: int) -> np.ndarray:
    """At most `most` of the indices 0 … count − 1, evenly spread, the first and the last among them."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int))


def drawn(count: int, most: int) -> np.ndarray:
    """At most `most` of the indices 0 … count − 1, drawn alike at each call, ascending.

    Strides of a quasi-random sequence, as particles have, would show a pattern.
    """
    return np.sort(np.random.default_rng(0).permutation(count)[:most])


def at_times(t, times, rows) -> np.ndarray:
    """Rows [n, q] at times [n], ascending, at other times t [...]: [..., q], linear between them."""
    return np.stack([np.interp(t, times, column) for column in np.transpose(rows)], axis=-1)


def lengths(vectors: np.ndarray) -> np.ndarray:
    """[...] Euclidean lengths of vectors [..., q]; half the time of `np.linalg.norm` where they are few."""
    return np.sqrt(np.einsum("...q,...q->...", vectors, vectors))


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
        raise ConfigError(f"{key}={shown(values)}{' ' * bool(unit)}{unit} must be {wanted}")
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
