"""A program of gravity: the floor is a lift."""

from dataclasses import dataclass

import numpy as np

from nsf.mpm import Gravity
from nsf.scenes import GravityProgram


@dataclass(frozen=True)
class Heave(GravityProgram):
    """Gravity g (1 + a sin(2π (f t + φ))), with a phase φ that each run draws.

    Attributes:
        amplitude: a, dimensionless.
        frequency: f [Hz].
    """

    amplitude: float
    frequency: float

    def of(self, gravity: Gravity, duration: float, generator: np.random.Generator) -> Gravity:
        """Keyframes of a run [m/s²], on top of gravity as the scene, or an earlier program, has it."""
        times = np.linspace(0.0, duration, 41)
        factors = 1.0 + self.amplitude * np.sin(2.0 * np.pi * (self.frequency * times + generator.random()))
        return Gravity(times.tolist(), (factors[:, None] * gravity.at(times)).tolist())

    def reach(self, gravity: float) -> float:
        """Largest change [m/s²] of a gravity of that size [m/s²]."""
        return self.amplitude * gravity
