"""Hencky elasticity (StVK in principal logarithmic strain)."""

from dataclasses import dataclass
from functools import cache

import numpy as np

from nsf.mpm.materials.base import LawFunctions, Material, no_params, no_return_map
from nsf.mpm.precision import Precision


@cache
def log_strain(precision: Precision):
    """Warp function F → (U, ε, V) with F = U exp(ε) Vᵀ, ε [3] the principal logarithmic strains."""
    import warp as wp

    vec3, mat33 = precision.vec3, precision.mat33

    @wp.func
    def decompose(F: mat33):
        U = mat33()
        V = mat33()
        sigma = vec3()
        wp.svd3(F, U, sigma, V)
        return U, vec3(wp.log(sigma[0]), wp.log(sigma[1]), wp.log(sigma[2])), V

    return decompose


@cache
def from_log_strain(precision: Precision):
    """Warp function (U, ε, V) → F = U exp(ε) Vᵀ, the inverse of `log_strain`."""
    import warp as wp

    vec3, mat33 = precision.vec3, precision.mat33

    @wp.func
    def compose(U: mat33, eps: vec3, V: mat33):
        return U * wp.diag(vec3(wp.exp(eps[0]), wp.exp(eps[1]), wp.exp(eps[2]))) * wp.transpose(V)

    return compose


@cache
def principal_tau(precision: Precision):
    """Warp function (U, ε, mu, lam) → τ = U (2μ̂ ε + λ tr(ε) 1) Uᵀ, `hencky_tau` of principal log strains."""
    import warp as wp

    real, vec3, mat33 = precision.real, precision.vec3, precision.mat33

    @wp.func
    def tau_of(U: mat33, eps: vec3, mu: real, lam: real):
        trace = eps[0] + eps[1] + eps[2]
        principal = real(2.0) * mu * eps + lam * trace * vec3(real(1.0), real(1.0), real(1.0))
        return U * wp.diag(principal) * wp.transpose(U)

    return tau_of


@cache
def hencky_tau(precision: Precision):
    """Warp function τ = U (2μ̂ ε + λ tr(ε) 1) Uᵀ with ε = log Σ, F = U Σ Vᵀ.

    Source: paper, appendix "StVK elasticity". Printed with Vᵀ on the right, which is
    neither symmetric nor objective; with Uᵀ it is the Kirchhoff stress of the energy
    ψ = μ̂ tr(ε²) + λ/2 tr(ε)².
    """
    import warp as wp

    real, mat33 = precision.real, precision.mat33
    vecH = wp.types.vector(length=1, dtype=real)
    decompose, stress = log_strain(precision), principal_tau(precision)

    @wp.func
    def tau_of(F: mat33, history: vecH, mu: real, lam: real):
        U, eps, _ = decompose(F)
        return stress(U, eps, mu, lam)

    return tau_of


def hencky_update(precision: Precision, flow, Params):
    """Warp function of the constitutive update of a law over Hencky elasticity: it decomposes F_trial once.

    Flow keeps the principal directions of F_trial = U exp(ε) Vᵀ, so that F_e has the same directions.

    Args:
        precision: floating-point types.
        flow: Warp function (ε, history, mu, lam, params) → (ε, history); ε is unchanged where nothing flows.
        Params: Warp struct of the law's constants.
    """
    import warp as wp

    real, mat33 = precision.real, precision.mat33
    vecH = wp.types.vector(length=1, dtype=real)
    decompose, compose = log_strain(precision), from_log_strain(precision)
    stress = principal_tau(precision)

    @wp.func
    def update(F_trial: mat33, history: vecH, mu: real, lam: real, params: Params, dt: real):
        U, eps, V = decompose(F_trial)
        eps_e, h = flow(eps, history, mu, lam, params)
        tau = stress(U, eps_e, mu, lam)
        if eps_e == eps:
            return F_trial, h, tau
        return compose(U, eps_e, V), h, tau

    return update


def hencky_stretches(principal: np.ndarray, mu: np.ndarray, lam: np.ndarray) -> np.ndarray:
    """Principal stretches exp(ε) of `hencky_tau`, ε = (τ − λ tr(τ)/(3λ + 2μ̂) 1)/(2μ̂).

    Args:
        principal: [P, 3] principal Kirchhoff stresses [Pa]; mu, lam: [P] Lamé parameters [Pa].
    """
    mu, lam = mu[:, None], lam[:, None]
    trace = principal.sum(1, keepdims=True)
    return np.exp((principal - lam / (3.0 * lam + 2.0 * mu) * trace) / (2.0 * mu))


@cache
def _functions(precision: Precision) -> LawFunctions:
    return LawFunctions(hencky_tau(precision), no_return_map(precision), no_params())


@dataclass(frozen=True)
class Hencky(Material):
    """Elastic solid, ψ = μ̂ tr(ε²) + λ/2 tr(ε)², ε the logarithmic strain."""

    def functions(self, precision: Precision) -> LawFunctions:
        """The law's Warp functions."""
        return _functions(precision)

    def stretches_of(self, principal: np.ndarray, mu: np.ndarray, lam: np.ndarray) -> np.ndarray:
        """[P, 3] stretches of [P, 3] principal stresses, in closed form."""
        return hencky_stretches(principal, mu, lam)
