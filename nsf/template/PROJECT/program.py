"""The program of this project: gravity in the course of a run."""

from dataclasses import dataclass

import numpy as np

from nsf.mpm import Gravity
from nsf.scenes import GravityProgram


@dataclass(frozen=True)
class Program(GravityProgram):
    """A lift that goes up and down, from a phase that each run draws. The scene has its constants' values."""

    amplitude: float  # [m/s²]
    frequency: float  # [Hz]

    def of(self, gravity: Gravity, duration: float, generator: np.random.Generator) -> Gravity:
        """Gravity of a run: that of the scene, and a change [m/s²] along x, y and z."""
        t = np.linspace(0.0, duration, 41)  # [s]
        change = np.zeros((len(t), 3))
        change[:, 2] = self.amplitude * np.sin(2.0 * np.pi * (self.frequency * t + generator.random()))
        return Gravity(t.tolist(), (gravity.at(t) + change).tolist())

    def reach(self, gravity: float) -> float:
        """Largest change [m/s²]."""
        return self.amplitude
