"""Herschel-Bulkley viscoplasticity: foams and pastes that flow above a yield stress."""

import math
from dataclasses import dataclass
from functools import cache

import numpy as np

from nsf.errors import ConfigError
from nsf.mpm.materials.base import LawFunctions, Material
from nsf.mpm.precision import Precision

_NEWTON_STEPS = 50  # from its start the mean shrinks by a third a step, then converges quadratically


@cache
def volumetric_deviatoric_tau(precision: Precision):
    """Warp function τ = κ/2 (J² − 1) I + μ̂ dev b̄ with b̄ = J^(−2/3) F Fᵀ, κ = λ + 2μ̂/3.

    The energy is ψ = κ/2 ((J² − 1)/2 − log J) + μ̂/2 (tr b̄ − 3). An inverted F (J < 0) gives NaN,
    on which the solver stops: κ/2 (J² − 1) is zero at J = −1 and would hide it.

    Source: Yue et al. 2015; paper, appendix "Herschel-Bulkley plasticity", where
    det(b)^(−1/3) = J^(−2/3).
    """
    import warp as wp

    real, mat33 = precision.real, precision.mat33
    vecH = wp.types.vector(length=1, dtype=real)

    @wp.func
    def tau_of(F: mat33, history: vecH, mu: real, lam: real):
        J = wp.determinant(F)
        b_bar = wp.pow(J, -real(2.0) / real(3.0)) * (F * wp.transpose(F))
        kappa = lam + real(2.0) / real(3.0) * mu
        pressure = real(0.5) * kappa * (J * J - real(1.0)) - mu * wp.trace(b_bar) / real(3.0)
        return mu * b_bar + pressure * wp.identity(n=3, dtype=real)

    return tau_of


@cache
def isochoric_mean(precision: Precision):
    """Warp function (deviator d [3], start) → m with Π (dᵢ + m) = 1, all dᵢ + m > 0.

    Because Σ dᵢ = 0, m is the largest root of m³ − (‖d‖²/2) m + d₁d₂d₃ = 1. The left side grows and is
    convex to the right of the root. Newton's steps from a start above the root therefore only go down, and
    end where rounding stops them.
    """
    import warp as wp

    real, vec3 = precision.real, precision.vec3

    @wp.func
    def newton(p: real, q: real, m: real):
        return m - ((m * m - p) * m - q) / (real(3.0) * m * m - p)

    @wp.func
    def mean(d: vec3, start: real):
        p = real(0.5) * wp.dot(d, d)
        q = real(1.0) - d[0] * d[1] * d[2]
        m = start
        below = newton(p, q, m)
        while below < m:
            m = below
            below = newton(p, q, m)
        return m

    return mean


def volumetric_deviatoric_stretches(principal: np.ndarray, mu: np.ndarray, lam: np.ndarray) -> np.ndarray:
    """Principal stretches of `volumetric_deviatoric_tau`: J from tr τ, b̄ = d + m 1 from d = dev τ/μ̂.

    J² = 1 + 2 tr(τ)/(3κ); m is the largest root of Π (dᵢ + m) = 1 (`isochoric_mean`), by Newton's steps down
    from 1 + max |dᵢ|, where every factor is at least 1.

    Args:
        principal: [P, 3] principal Kirchhoff stresses [Pa]; mu, lam: [P] Lamé parameters [Pa].

    Returns:
        [P, 3]; NaN where tr τ is below what an empty volume carries.
    """
    pressure = principal.mean(1, keepdims=True)
    kappa = (lam + 2.0 / 3.0 * mu)[:, None]
    J = np.sqrt(1.0 + 2.0 * pressure / kappa)
    d = (principal - pressure) / mu[:, None]
    p, q = 0.5 * (d * d).sum(1, keepdims=True), 1.0 - d.prod(1, keepdims=True)
    m = 1.0 + np.abs(d).max(1, keepdims=True)
    for _ in range(_NEWTON_STEPS):
        m = m - ((m * m - p) * m - q) / (3.0 * m * m - p)
    return J ** (1.0 / 3.0) * np.sqrt(d + m)


@cache
def _functions(precision: Precision) -> LawFunctions:
    import warp as wp

    real, vec3, mat33 = precision.real, precision.vec3, precision.mat33
    vecH = wp.types.vector(length=1, dtype=real)
    mean_of = isochoric_mean(precision)

    @wp.struct
    class Params:
        radius: real
        viscosity: real

    @wp.func
    def return_map(F_trial: mat33, history: vecH, mu: real, lam: real, params: Params, dt: real):
        U = mat33()
        V = mat33()
        sigma = vec3()
        wp.svd3(F_trial, U, sigma, V)
        J_third = wp.pow(sigma[0] * sigma[1] * sigma[2], real(1.0) / real(3.0))
        stretch = sigma / J_third
        b_bar = wp.cw_mul(stretch, stretch)
        m = (b_bar[0] + b_bar[1] + b_bar[2]) / real(3.0)
        d = b_bar - vec3(m, m, m)
        s_trial = mu * wp.length(d)
        if s_trial <= params.radius:
            return F_trial, history
        s = s_trial - (s_trial - params.radius) / (real(1.0) + params.viscosity / (real(2.0) * mu * dt))
        d = (s / s_trial) * d
        # log det is concave, so shrinking the deviator at a fixed mean raises the determinant:
        # the trial mean lies above the one sought.
        m = mean_of(d, m)
        stretch = J_third * vec3(wp.sqrt(d[0] + m), wp.sqrt(d[1] + m), wp.sqrt(d[2] + m))
        return U * wp.diag(stretch) * wp.transpose(V), history

    return LawFunctions(volumetric_deviatoric_tau(precision), return_map, Params)


@dataclass(frozen=True)
class HerschelBulkley(Material):
    """Elastic below ‖s‖ = √(2/3) σ_Y, s = dev τ; above it flows with a linear viscosity (h = 1).

    ‖s‖ = ‖s_trial‖ − (‖s_trial‖ − √(2/3) σ_Y)/(1 + η/(2μ̂Δt)), along s_trial: in steady shear
    ‖s‖ = √(2/3) σ_Y + η γ̇/√2 whatever Δt, as long as the strain of a step and ‖s‖/μ̂ are small.

    Attributes:
        yield_stress: σ_Y [Pa], not negative.
        viscosity: η [Pa s], not negative; 0 is perfect plasticity.

    Raises:
        ConfigError: a value lies outside its physical range.

    Source: Yue et al. 2015; paper, appendix "Herschel-Bulkley plasticity". The paper gives s but
    not the F_e that carries it; here the trace of b̄ follows from det b̄ = 1, so that s is the one
    printed and det F_e is kept to rounding.
    """

    yield_stress: float
    viscosity: float

    def __post_init__(self):
        super().__post_init__()
        if not 0.0 <= self.yield_stress < math.inf:
            raise ConfigError(f"material.yield_stress={self.yield_stress} Pa must be finite and not negative")
        if not 0.0 <= self.viscosity < math.inf:
            raise ConfigError(f"material.viscosity={self.viscosity} Pa s must be finite and not negative")

    @property
    def radius(self) -> float:
        """√(2/3) σ_Y, the largest ‖s‖ of an elastic state [Pa]."""
        return math.sqrt(2.0 / 3.0) * self.yield_stress

    def functions(self, precision: Precision) -> LawFunctions:
        """The law's Warp functions."""
        return _functions(precision)

    def stretches_of(self, principal: np.ndarray, mu: np.ndarray, lam: np.ndarray) -> np.ndarray:
        """[P, 3] stretches of [P, 3] principal stresses; volume and shape apart."""
        return volumetric_deviatoric_stretches(principal, mu, lam)
