"""The box of nodes that the background grid is."""

from dataclasses import dataclass

import numpy as np

from nsf.errors import ConfigError
from nsf.mpm.precision import Precision

#: Nodes along the edge of a block, the part of the grid that is cleared and updated as one.
BLOCK = 4
# A kernel's index of a node is a signed one of 32 bits, also that of the last block's end.
_MOST_NODES = 2**31 - 2**20


@dataclass(frozen=True)
class GridGeometry:
    """A box of nodes x_i = dx·(i, j, k) that starts at the origin.

    Attributes:
        dx: spacing [m].
        nodes: number of nodes an axis.
    """

    dx: float
    nodes: tuple[int, int, int]

    @classmethod
    def of_domain(cls, size: tuple[float, float, float], dx: float) -> "GridGeometry":
        """Grid that covers [0, size].

        Args:
            size: domain edge lengths [m].
            dx: spacing [m].

        Raises:
            ConfigError: the spacing is not positive, leaves fewer than 8 cells an axis or makes more nodes
                than the solver numbers.
        """
        if not dx > 0:
            raise ConfigError(f"dx={dx} m must be positive")
        with np.errstate(over="ignore"):
            edges = np.ceil(np.divide(size, dx) - 1e-9)
            count = np.prod(edges + 1.0)
        if not count <= _MOST_NODES:
            coarse = float(np.prod(np.cbrt(size))) * _MOST_NODES ** (-1 / 3)
            raise ConfigError(
                f"dx={dx} m makes {count:.3g} grid nodes of 32 bytes ({32 * count / 2**30:,.0f} GiB), "
                f"more than the {_MOST_NODES} that the solver numbers; choose dx above {coarse:.2g} m"
            )
        cells = tuple(map(int, edges))
        if min(cells) < 8:
            raise ConfigError(
                f"dx={dx} m leaves {min(cells)} cells across the domain {tuple(size)} m; choose a smaller dx"
            )
        return cls(float(dx), tuple(c + 1 for c in cells))

    @property
    def count(self) -> int:
        """Number of nodes."""
        return int(np.prod(self.nodes))

    @property
    def blocks(self) -> tuple[int, int, int]:
        """Number of blocks of 4³ nodes an axis; the last may reach over the edge."""
        return tuple(-(-n // BLOCK) for n in self.nodes)

    def nbytes(self, precision: Precision) -> int:
        """[byte] of a `Grid` of all its nodes."""
        node = 4 * np.dtype(precision.numpy).itemsize
        return self.count * node + 2 * 4 * int(np.prod(self.blocks)) + 4

    @property
    def upper(self) -> tuple[float, float, float]:
        """Position of the last node [m]."""
        return tuple((n - 1) * self.dx for n in self.nodes)
