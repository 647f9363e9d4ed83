"""A cubature out of few cells: it needs fewer integration particles than one from all over the body."""

from dataclasses import dataclass

import numpy as np
import torch
from typing_extensions import override

from nsf.dynamics.cubature import CubatureSampler, Equations, nonnegative_fit
from nsf.errors import ConfigError


@dataclass(frozen=True)
class CellSampler(CubatureSampler):
    """A cubature whose particles are all from few cells of the grid, as the body lies in it at rest.

    N are the particles that share a node with S, hundreds for each of S where these are far apart; those of
    one cell have nearly all of theirs in common. First cells are taken, each with the sums over all its
    particles, as the cubature takes particles, and then particles with weights among those in these cells.

    Attributes:
        cells: number of cells at most.

    Raises:
        ConfigError: cells is not a positive whole number.
    """

    cells: int = 12

    def __post_init__(self):
        super().__post_init__()
        if not isinstance(self.cells, int) or self.cells < 1:
            raise ConfigError(f"sampler.cells={self.cells} must be a whole number of at least 1")

    @override
    def among(self, X: np.ndarray, equations: Equations) -> np.ndarray:
        _, cell = np.unique(np.floor(X / equations.dx).astype(int), axis=0, return_inverse=True)
        columns = equations.columns
        of_cells = columns.new_zeros(len(columns), int(cell.max()) + 1)
        of_cells.index_add_(1, torch.as_tensor(cell.ravel(), device=columns.device), columns)
        chosen, _ = nonnegative_fit(of_cells, equations.target, self.cells)
        return np.flatnonzero(np.isin(cell.ravel(), chosen))
