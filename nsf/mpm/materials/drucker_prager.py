"""Drucker-Prager plasticity over Hencky elasticity: dry sand."""

import math
from dataclasses import dataclass
from functools import cache

import numpy as np

from nsf.errors import ConfigError
from nsf.mpm.materials.base import LawFunctions, Material
from nsf.mpm.materials.hencky import hencky_stretches, hencky_tau, hencky_update
from nsf.mpm.precision import Precision


@cache
def _functions(precision: Precision) -> LawFunctions:
    import warp as wp

    real, vec3 = precision.real, precision.vec3
    vecH = wp.types.vector(length=1, dtype=real)

    @wp.struct
    class Params:
        alpha: real

    @wp.func
    def flow(eps: vec3, history: vecH, mu: real, lam: real, params: Params):
        trace = eps[0] + eps[1] + eps[2]
        # No cohesion: under expansion the material carries nothing (tested before the cone).
        if trace > real(0.0):
            return vec3(), history
        third = trace / real(3.0)
        deviator = eps - vec3(third, third, third)
        size = wp.length(deviator)
        excess = size + params.alpha * (real(3.0) * lam + real(2.0) * mu) * trace / (real(2.0) * mu)
        if excess <= real(0.0):
            return eps, history
        return eps - (excess / size) * deviator, history

    return LawFunctions(hencky_tau(precision), None, Params, hencky_update(precision, flow, Params))


@dataclass(frozen=True)
class DruckerPrager(Material):
    """Cohesionless frictional solid; the cone is matched to Mohr-Coulomb in triaxial compression.

    On the cone ‖dev τ‖ = −α tr τ, α = √(2/3) · 2 sin φ/(3 − sin φ). In plane strain it acts
    as a larger angle, sin φ_ps = 2√3 sin φ/(3 − sin φ), which reaches 90° at φ = 42.2°.

    Attributes:
        friction_angle: φ_f [degrees], in [0, 90).

    Source: Klár et al. 2016; paper, appendix "Drucker-Prager plasticity" (d = 3).
    """

    friction_angle: float = 30.0

    def __post_init__(self):
        super().__post_init__()
        if not 0.0 <= self.friction_angle < 90.0:
            raise ConfigError(f"material.friction_angle={self.friction_angle} degrees must lie in [0, 90)")

    @property
    def alpha(self) -> float:
        """Slope of the cone, dimensionless."""
        sine = math.sin(math.radians(self.friction_angle))
        return math.sqrt(2.0 / 3.0) * 2.0 * sine / (3.0 - sine)

    def functions(self, precision: Precision) -> LawFunctions:
        """The law's Warp functions."""
        return _functions(precision)

    def stretches_of(self, principal: np.ndarray, mu: np.ndarray, lam: np.ndarray) -> np.ndarray:
        """[P, 3] stretches of [P, 3] principal stresses, in closed form."""
        return hencky_stretches(principal, mu, lam)
