"""The hardening law of this project."""

import math
from dataclasses import dataclass

from nsf.mpm.materials import IsotropicHardening


@dataclass(frozen=True)
class Law(IsotropicHardening):
    """Voce hardening: from `yield_stress` towards `saturation`. `E` and `nu` are inherited."""

    yield_stress: float  # [Pa]
    saturation: float  # [Pa]
    rate: float  # [-]

    def flow_stress(self, gamma):
        """Largest ‖dev τ‖ [Pa] at the plastic strain γ; a number alone takes its type: `type(gamma)(2.0)`."""
        return self.saturation + (self.yield_stress - self.saturation) * math.exp(-self.rate * gamma)
