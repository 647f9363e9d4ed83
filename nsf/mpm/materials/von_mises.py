"""Von Mises plasticity over Hencky elasticity: perfect, with hardening, or with softening to damage."""

import math
from dataclasses import dataclass
from functools import cache

import numpy as np

from nsf.errors import ConfigError
from nsf.mpm.materials.base import LawFunctions, Material
from nsf.mpm.materials.hencky import hencky_stretches, hencky_tau, hencky_update
from nsf.mpm.precision import Precision


def deviator_norm(tau: np.ndarray) -> np.ndarray:
    """[P] ‖dev τ‖ [Pa] of [P, 3, 3] Kirchhoff stresses [Pa]."""
    mean = np.trace(tau, axis1=1, axis2=2)[:, None, None] / 3.0
    return np.linalg.norm(tau - mean * np.eye(3), axis=(1, 2))


def von_mises_update(precision: Precision, bound, hardened, Params):
    """Warp function of the constitutive update of a von Mises law over Hencky elasticity.

    Args:
        precision: floating-point types.
        bound: Warp function (h, params) → τ_Y [Pa] of a particle whose history variable is h.
        hardened: Warp function (h, δγ, mu, params) → h after plastic flow δγ, the ‖ε̂‖ that it takes.
        Params: Warp struct of the constants that these take.
    """
    import warp as wp

    real, vec3 = precision.real, precision.vec3
    vecH = wp.types.vector(length=1, dtype=real)

    # Written so that a NaN does not count as elastic, and reaches the solver's check.
    @wp.func
    def flow(eps: vec3, history: vecH, mu: real, lam: real, params: Params):
        tau_Y = bound(history[0], params)
        third = (eps[0] + eps[1] + eps[2]) / real(3.0)
        deviator = eps - vec3(third, third, third)
        size = wp.length(deviator)
        if real(2.0) * mu * size <= tau_Y:
            return eps, history
        # The return removes `flowed` along a unit direction, so ‖ε − proj ε‖ is `flowed` itself.
        flowed = size - tau_Y / (real(2.0) * mu)
        return eps - (flowed / size) * deviator, vecH(hardened(history[0], flowed, mu, params))

    return hencky_update(precision, flow, Params)


@cache
def _functions(precision: Precision) -> LawFunctions:
    import warp as wp

    real, mat33 = precision.real, precision.mat33
    vecH = wp.types.vector(length=1, dtype=real)
    elastic_tau = hencky_tau(precision)

    @wp.struct
    class Params:
        hardening: real
        softening: real

    @wp.func
    def bound(tau_Y: real, params: Params):
        return tau_Y

    @wp.func
    def hardened(tau_Y: real, flowed: real, mu: real, params: Params):
        return tau_Y + (real(2.0) * mu * params.hardening - params.softening) * flowed

    flowing_update = von_mises_update(precision, bound, hardened, Params)

    @wp.func
    def tau_of(F: mat33, history: vecH, mu: real, lam: real):
        if history[0] <= real(0.0):
            return mat33()
        return elastic_tau(F, history, mu, lam)

    # Written so that a NaN does not count as damaged, and reaches the solver's check.
    @wp.func
    def update(F_trial: mat33, history: vecH, mu: real, lam: real, params: Params, dt: real):
        if history[0] <= real(0.0):
            return wp.identity(n=3, dtype=real), history, mat33()
        F_e, h, tau = flowing_update(F_trial, history, mu, lam, params, dt)
        if h[0] <= real(0.0):
            tau = mat33()
        return F_e, h, tau

    return LawFunctions(tau_of, None, Params, update)


@dataclass(frozen=True)
class VonMises(Material):
    """Perfectly plastic solid: ‖dev τ‖ ≤ τ_Y, plastic flow keeps the volume.

    A trial state outside returns along its deviator, ε ← ε − δγ ε̂/‖ε̂‖ with ε̂ = dev ε and
    δγ = ‖ε̂‖ − τ_Y/(2μ̂). The history of a particle is its τ_Y [Pa].

    Attributes:
        yield_stress: τ_Y at rest [Pa], positive; √1.5 τ_Y in uniaxial stress, τ_Y/√2 in shear.

    Raises:
        ConfigError: a value lies outside its physical range.

    Source: paper, appendix "von Mises plasticity" (d = 3). Printed with δγ ε̂/‖ε‖, which does not
    land on the yield surface once the volume changes; ‖ε̂‖ does.
    """

    yield_stress: float

    def __post_init__(self):
        super().__post_init__()
        if not 0.0 < self.yield_stress < math.inf:
            raise ConfigError(f"material.yield_stress={self.yield_stress} Pa must be positive and finite")

    def initial_history(self, particles: int) -> np.ndarray:
        """[P, 1] yield stress τ_Y [Pa] at rest."""
        return np.full((particles, 1), float(self.yield_stress))

    def functions(self, precision: Precision) -> LawFunctions:
        """The law's Warp functions."""
        return _functions(precision)

    def stretches_of(self, principal: np.ndarray, mu: np.ndarray, lam: np.ndarray) -> np.ndarray:
        """[P, 3] stretches of [P, 3] principal stresses, in closed form."""
        return hencky_stretches(principal, mu, lam)


@dataclass(frozen=True)
class VonMisesHardening(VonMises):
    """Yield stress that grows with plastic flow, τ_Y ← τ_Y + 2μ̂ ξ δγ.

    Each return goes to the yield stress before the step. ‖dev τ‖ therefore lags by one step,
    and its slope d‖dev τ‖/d‖ε̂‖ → 2μ̂ ξ/(1 + ξ) is met to first order in the strain step.

    Attributes:
        hardening: ξ, dimensionless, not negative.

    Raises:
        ConfigError: a value lies outside its physical range.

    Source: paper, appendix "von Mises plasticity"; Wang et al. 2019.
    """

    hardening: float

    def __post_init__(self):
        super().__post_init__()
        if not 0.0 <= self.hardening < math.inf:
            raise ConfigError(f"material.hardening={self.hardening} must be finite and not negative")

    def history_of(self, tau: np.ndarray) -> np.ndarray:
        """[P, 1] lower bound of τ_Y [Pa]: the larger of τ_Y at rest and the ‖dev τ‖ that is carried.

        The bound misses the hardening of a particle that has unloaded since.
        """
        return np.maximum(deviator_norm(tau), self.yield_stress)[:, None]


@dataclass(frozen=True)
class VonMisesSoftening(VonMises):
    """Yield stress that falls with plastic flow, τ_Y ← τ_Y − θ ‖ε − proj ε‖, down to damage.

    A particle whose τ_Y reaches zero is damaged for good: τ = 0, as the paper's zero Lamé parameters
    give. τ_Y ≤ 0 marks the damage, so the particle's moduli stay constants. From the next step on its
    F_e is held at I: a product of increments that nothing resists would overflow in a long run, and
    the elastic strain of a material without stiffness has no meaning. τ alone does not tell damage,
    because a damaged particle looks like an unloaded one. `history_of` therefore gives τ_Y at rest, an
    upper bound.

    Attributes:
        softening: θ [Pa] lost by τ_Y for a unit of plastic logarithmic strain, not negative.

    Raises:
        ConfigError: a value lies outside its physical range.

    Source: paper, appendix "von Mises plasticity"; Wang et al. 2019. The paper has no law that both
    hardens and softens.
    """

    softening: float

    def __post_init__(self):
        super().__post_init__()
        if not 0.0 <= self.softening < math.inf:
            raise ConfigError(f"material.softening={self.softening} Pa must be finite and not negative")
