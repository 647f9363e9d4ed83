"""Colour scales of quantities and colours of categories, safe for the colour-blind."""

from collections.abc import Mapping

import matplotlib
import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize, PowerNorm, to_rgb

STRESS_COLORS, DIFFERENCE_COLORS, SIGNED_COLORS = "viridis", "magma", "coolwarm"
CLIP = 93.0  # [%] percentile of the full-order stress at which the colour scale ends

PASCALS = ((1e6, "MPa"), (1e3, "kPa"), (1.0, "Pa"), (1e-3, "mPa"), (1e-6, "µPa"))
METRES = ((1.0, "m"), (1e-3, "mm"), (1e-6, "µm"))

#: Colours of a particle in neither set, in N only, and in S; of Okabe and Ito 2008.
ROLES = ("#BBBBBB", "#0072B2", "#D55E00")


class ColorScale:
    """A colour scale from zero, in the unit that suits its end.

    Args:
        top: where it ends, in SI.
        cmap: of matplotlib.
        factor, unit: of what is written beside it.
        title: of the quantity.
        power: of the share of `top` that a colour stands for; below 1 it parts small values.
    """

    def __init__(self, top: float, cmap: str, factor: float, unit: str, title: str = "", power: float = 1.0):
        self.factor, self.unit, self.top, self.title = factor, unit, top, title
        scale = Normalize(0.0, top / factor) if power == 1.0 else PowerNorm(power, 0.0, top / factor)
        self.mappable = ScalarMappable(scale, matplotlib.colormaps[cmap])

    @classmethod
    def up_to(cls, top: float, cmap: str, units, title: str = "", power: float = 1.0) -> "ColorScale":
        """`top` in SI; the largest unit in which it is no less than 0.3 is taken."""
        top = float(top) if np.isfinite(top) and top > 0 else units[-1][0]
        factor, unit = next(((f, u) for f, u in units if top >= 0.3 * f), units[-1])
        return cls(top, cmap, factor, unit, title, power)

    @property
    def label(self) -> str:
        """The quantity and its unit."""
        return f"{self.title} [{self.unit}]"

    def colors(self, values: np.ndarray) -> np.ndarray:
        """Values in SI as colours [n,3]; what is not finite takes the end of the scale."""
        return self.mappable.to_rgba(self._clipped(values))[:, :3]

    def pixels(self, values: np.ndarray) -> np.ndarray:
        """The same as numbers of 8 bits."""
        return self.mappable.to_rgba(self._clipped(values), bytes=True)[:, :3]

    def _clipped(self, values: np.ndarray) -> np.ndarray:
        return np.minimum(np.nan_to_num(values, nan=np.inf), self.top) / self.factor


class Categories:
    """Colours of categories, which are numbered from 0 in the mapping's order.

    Args:
        named: colour by name.
    """

    def __init__(self, named: Mapping[str, str]):
        self.named = named
        self._table = np.array([to_rgb(color) for color in named.values()])

    def colors(self, values: np.ndarray) -> np.ndarray:
        """Numbers of categories as colours [n,3]."""
        return self._table[values.astype(int)]
