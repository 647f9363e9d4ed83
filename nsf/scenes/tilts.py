"""Directions of gravity: tilts of it, and how far one may go."""

import numpy as np


def tilted(gravity: np.ndarray, tilt: np.ndarray) -> np.ndarray:
    """Gravity [n, 3] [m/s²] turned by tilts [n, 2] [rad] along two directions across its first value."""
    size = np.linalg.norm(gravity, axis=1, keepdims=True)
    angle = np.linalg.norm(tilt, axis=1, keepdims=True)
    aside = tilt @ across(gravity[0])
    return size * (np.cos(angle) * normalised(gravity) + np.sinc(angle / np.pi) * aside)


def largest_tilt(gravity: np.ndarray, middle: np.ndarray, reach: float) -> float:
    """Largest angle [rad] by which gravity [3] may tilt either way and stay within a ball [3] [m/s²].

    Tilted by θ away from the middle m it is off by |g|² + |m|² − 2 |g| |m| cos(θ + φ), squared, with φ the
    angle between both.
    """
    size, around = np.linalg.norm(gravity), max(float(np.linalg.norm(middle)), 1e-30)
    between = np.arccos(np.clip(gravity @ middle / (size * around), -1.0, 1.0))
    cosine = (size**2 + around**2 - reach**2) / (2.0 * size * around)
    return max(0.0, float(np.arccos(np.clip(cosine, -1.0, 1.0)) - between))


def across(gravity: np.ndarray) -> np.ndarray:
    """[2, 3] unit vectors across gravity [3]: x and y where it points along z."""
    down = normalised(gravity) if np.any(gravity) else np.array([0.0, 0.0, -1.0])
    axis = np.eye(3)[0 if abs(down[0]) < 0.9 else 1]
    one = normalised(axis - (axis @ down) * down)
    return np.stack([one, np.cross(-down, one)])


def normalised(values: np.ndarray) -> np.ndarray:
    """Vectors [..., 3] of length 1; zero stays zero."""
    size = np.linalg.norm(values, axis=-1, keepdims=True)
    return values / np.where(size > 0.0, size, 1.0)
