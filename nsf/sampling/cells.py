"""A cubature out of few cells: it needs fewer integration particles than one from all over the body."""

from dataclasses import dataclass

import numpy as np
import torch
from typing_extensions import override

from nsf.sampling.cubature import CubatureSampler, Equations, nonnegative_fit
from nsf.scalars import number


@dataclass(frozen=True)
class CellSampler(CubatureSampler):
    """A cubature whose particles are all from few cells of the grid, as the body lies in it at rest.

    N are the particles that share a node with S, many for each of S where these are far apart; those of a
    cell share most of theirs. First cells are taken, each with the sums over its candidates, as the cubature
    takes particles, and then particles with weights among those in these cells. Cells lie between nodes:
    particles whose stencils are the same would need still fewer others, but all see the same nodes, and tell
    less of the motion.

    Attributes:
        cells: number of cells at most.

    Raises:
        ConfigError: cells is not a positive whole number.

    Source: the choice of particles is that of `CubatureSampler`; cells before them are our own.
    """

    cells: int = 16

    def __post_init__(self):
        super().__post_init__()
        number("sampler.cells", self.cells, 1, whole=True)

    @override
    def among(self, equations: Equations) -> np.ndarray:
        _, cell = np.unique(equations.cells, axis=0, return_inverse=True)
        cell = cell.ravel()
        chosen, _ = nonnegative_fit(added_up(equations.columns, cell), equations.target, self.cells)
        return np.flatnonzero(np.isin(cell, chosen))


def added_up(columns: torch.Tensor, cell: np.ndarray) -> torch.Tensor:
    """Sums [m, cells] of the columns [m, c] of each cell, in the order of the columns on any device."""
    order = np.argsort(cell, kind="stable")
    _, first, count = np.unique(cell[order], return_index=True, return_counts=True)
    sums = columns.new_zeros(len(columns), len(first))
    for turn in range(count.max()):  # one of each cell at a time
        more = count > turn
        rows, cells = (torch.as_tensor(a, device=columns.device) for a in (order[first[more] + turn], more))
        sums[:, cells] += columns[:, rows]
    return sums
