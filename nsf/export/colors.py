"""The colour map of exported points."""

import matplotlib
import numpy as np

MAP = "viridis"


def mapped(values: np.ndarray, top: float) -> np.ndarray:
    """Values [...] from 0 to `top`, and above, as colours [..., 3] in 0..1."""
    return matplotlib.colormaps[MAP](np.clip(values / top, 0.0, 1.0))[..., :3]


def table(count: int = 256) -> list[int]:
    """The map as `count` colours, red, green and blue in 0..255 one after the other."""
    return (255 * mapped(np.linspace(0, 1, count), 1.0)).round().astype(int).ravel().tolist()
