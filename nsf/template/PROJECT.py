"""The hardening law and the gravity program of this project."""

import math
from dataclasses import dataclass

import numpy as np
from nsf.mpm.materials import IsotropicHardening
from nsf.scenes import GravityCurve


@dataclass(frozen=True)
class Law(IsotropicHardening):
    """Voce hardening, from `yield_stress` to 1 + `gain` times it. Only `E` and `nu` are fixed names."""

    yield_stress: float  # [Pa]
    gain: float = 4.0
    rate: float = 25.0

    def flow_stress(self, p):
        """Stress of a tensile test [Pa] at the equivalent plastic strain `p`."""
        return self.yield_stress * (1.0 + self.gain * (1.0 - math.exp(-self.rate * p)))


class Program(GravityCurve):
    """A lift that goes up and down, otherwise in each run."""

    def values(self, t, gravity, draw):
        """Gravity [m/s²] at times `t` [s], columns x, y, z; `draw(low, high)` differs from run to run."""
        gravity[:, 2] += 5.0 * np.sin(2.0 * np.pi * (1.2 * t / t[-1] + draw(0.0, 1.0)))
        return gravity
