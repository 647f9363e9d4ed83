"""The gravity program of this project."""

from dataclasses import dataclass

import numpy as np

from nsf.mpm import Gravity
from nsf.scenes import GravityProgram


@dataclass(frozen=True)
class Program(GravityProgram):
    """A lift that goes up and down, from a phase that each run draws."""

    amplitude: float  # [m/s²]
    frequency: float  # [Hz]

    def of(self, gravity: Gravity, duration: float, generator: np.random.Generator) -> Gravity:
        """Gravity in the course of a run: the scene's, and a change along x, y and z."""
        t = np.linspace(0.0, duration, 41)  # [s]
        change = np.zeros((len(t), 3))  # [m/s²]
        change[:, 2] = self.amplitude * np.sin(2.0 * np.pi * (self.frequency * t + generator.random()))
        return Gravity(t.tolist(), (gravity.at(t) + change).tolist())

    def reach(self, gravity: float) -> float:
        """Largest size of `change` in any run [m/s²]: gravity further off is beyond what was taught."""
        return self.amplitude
