"""Parameters, start and forcing of runs, from which a model of latent vectors computes them."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Inputs:
    """Parameters, start and forcing of B runs of a scene, in fp64.

    Attributes:
        names: of the problem parameters; parameters: [B, n] their values.
        start: [B, r] x̂ at t = 0.
        gravity: [B, N, 3] at the start of each step [m/s²].
        solids: [B, N, f] state of the solids there: of each shift [m], angle [rad] and their changes in a
            step (`nsf.recurrence.collider_states`).
        dt: step [s].
    """

    names: tuple[str, ...]
    parameters: np.ndarray
    start: np.ndarray
    gravity: np.ndarray
    solids: np.ndarray
    dt: float
