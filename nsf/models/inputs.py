"""Parameters, start and forcing of runs, which a model of latent vectors computes, and runs to learn from."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Inputs:
    """Parameters, start and forcing of B runs of a scene, in fp64.

    Attributes:
        names: of the problem parameters; parameters: [B, n] their values.
        start: [B, r] x̂ at t = 0; first: [B, r] its change in the step before, from the initial velocity.
        gravity: [B, N, 3] at the start of each step [m/s²].
        solids: [B, N, f] state of the solids there: of each shift [m], angle [rad] and their changes in a
            step (`nsf.recurrence.collider_states`).
        dt: step [s].
    """

    names: tuple[str, ...]
    parameters: np.ndarray
    start: np.ndarray
    first: np.ndarray
    gravity: np.ndarray
    solids: np.ndarray
    dt: float

    def in_strides(self, stride: int) -> np.ndarray:
        """[B, N / k, n + 3 + f] parameters, and gravity and solids, means over strides of k steps."""
        runs, steps = self.gravity.shape[:2]
        along = [v.reshape(runs, steps // stride, stride, -1).mean(2) for v in (self.gravity, self.solids)]
        shape = (runs, steps // stride, self.parameters.shape[1])
        return np.concatenate([np.broadcast_to(self.parameters[:, None], shape), *along], 2)


@dataclass(frozen=True)
class Lessons:
    """Full-order runs in latent coordinates, with their inputs.

    Attributes:
        inputs: what determines them.
        xhat: [B, N + 1, r]; stress: [B, N + 1, n_s] coordinates ŝ of τ, none where its field has no modes.
    """

    inputs: Inputs
    xhat: np.ndarray
    stress: np.ndarray


@dataclass(frozen=True)
class Validation:
    """Full-order runs by which a fit is chosen, none of them held out.

    Attributes:
        inputs: what determines them.
        error: x̂ [B, N + 1, r] → mean displacement error, a fraction; not finite where a run is lost.
        moves: [r] how far particles move with each coordinate, RMS [m] a unit of it.
    """

    inputs: Inputs
    error: Callable[[np.ndarray], float]
    moves: np.ndarray
