"""Von Mises plasticity whose yield stress grows towards a bound: Voce hardening."""

from dataclasses import dataclass
from functools import cache

import numpy as np

from nsf.errors import ConfigError
from nsf.mpm.materials import LawFunctions, VonMises
from nsf.mpm.materials.hencky import hencky_tau
from nsf.mpm.materials.von_mises import von_mises_update
from nsf.mpm.precision import Precision


@cache
def _functions(precision: Precision) -> LawFunctions:
    import warp as wp  # where the law is simulated: its values are checked without it

    real = precision.real

    @wp.struct
    class Params:  # attributes of the law, by name
        saturation: real
        rate: real

    @wp.func
    def hardened(tau_Y: real, flowed: real, mu: real, params: Params):  # the law: τ_Y [Pa] after flow δγ
        return params.saturation + (tau_Y - params.saturation) * wp.exp(-params.rate * flowed)

    return LawFunctions(hencky_tau(precision), None, Params, von_mises_update(precision, hardened, Params))


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
