"""Von Mises plasticity whose yield stress grows towards a bound: Voce hardening."""

from dataclasses import dataclass
from functools import cache

import numpy as np
import warp as wp

from nsf.errors import ConfigError
from nsf.mpm.materials import VonMises
from nsf.mpm.materials.base import LawFunctions
from nsf.mpm.materials.hencky import hencky_tau, hencky_update
from nsf.mpm.precision import Precision


@cache
def _functions(precision: Precision) -> LawFunctions:
    real, vec3 = precision.real, precision.vec3
    vecH = wp.types.vector(length=1, dtype=real)

    @wp.struct
    class Params:
        saturation: real
        rate: real

    @wp.func
    def flow(eps: vec3, history: vecH, mu: real, lam: real, params: Params):
        tau_Y = history[0]
        third = (eps[0] + eps[1] + eps[2]) / real(3.0)
        deviator = eps - vec3(third, third, third)
        size = wp.length(deviator)
        if real(2.0) * mu * size <= tau_Y:
            return eps, history
        flowed = size - tau_Y / (real(2.0) * mu)
        tau_Y = params.saturation + (tau_Y - params.saturation) * wp.exp(-params.rate * flowed)
        return eps - (flowed / size) * deviator, vecH(tau_Y)

    return LawFunctions(hencky_tau(precision), None, Params, hencky_update(precision, flow, Params))


@dataclass(frozen=True)
class Saturating(VonMises):
    """Yield stress τ_Y that flow δγ takes towards τ_∞: τ_Y ← τ_∞ + (τ_Y − τ_∞) exp(−κ δγ).

    The history of a particle is its τ_Y [Pa], which starts at `yield_stress` as in `VonMises`.

    Attributes:
        saturation: τ_∞ [Pa], at least `yield_stress`.
        rate: κ, dimensionless, not negative.

    Raises:
        ConfigError: a value lies outside its physical range.
    """

    saturation: float
    rate: float

    def __post_init__(self):
        super().__post_init__()
        if not self.yield_stress <= self.saturation < np.inf:
            raise ConfigError(
                f"material.saturation={self.saturation} Pa must be finite, from yield_stress on"
            )
        if not 0.0 <= self.rate < np.inf:
            raise ConfigError(f"material.rate={self.rate} must be finite and not negative")

    def functions(self, precision: Precision) -> LawFunctions:
        """The law's Warp functions."""
        return _functions(precision)

    def params(self, precision: Precision):
        """The law's constants as its Warp struct."""
        params = self.functions(precision).Params()
        params.saturation = precision.real(self.saturation)
        params.rate = precision.real(self.rate)
        return params
