"""Fixed corotated elasticity."""

from dataclasses import dataclass
from functools import cache

import numpy as np

from nsf.mpm.materials.base import LawFunctions, Material, no_params, no_return_map
from nsf.mpm.precision import Precision

_VOLUMES = (0.5, 8.0)  # [-] of J: below 1/2 the pressure falls again under compression; 8 is a bracket
_NEWTON_STEPS = 60  # a few for Newton's method; as many for halving alone
_CLOSED = 1e-12  # [-] a last step of J below this is an answer


@cache
def fixed_corotated_tau(precision: Precision):
    """Warp function τ = 2μ̂ (F − R) Fᵀ + λ (J − 1) J I.

    Source: paper, appendix "Fixed corotated elasticity"; the identity is missing in print.
    """
    import warp as wp

    real, vec3, mat33 = precision.real, precision.vec3, precision.mat33
    vecH = wp.types.vector(length=1, dtype=real)

    @wp.func
    def tau_of(F: mat33, history: vecH, mu: real, lam: real):
        U = mat33()
        V = mat33()
        sigma = vec3()
        wp.svd3(F, U, sigma, V)
        R = U * wp.transpose(V)
        J = wp.determinant(F)
        return real(2.0) * mu * (F - R) * wp.transpose(F) + (lam * (J - real(1.0)) * J) * wp.identity(
            n=3, dtype=real
        )

    return tau_of


def fixed_corotated_stretches(principal: np.ndarray, mu: np.ndarray, lam: np.ndarray) -> np.ndarray:
    """Principal stretches of `fixed_corotated_tau` on the branch through the identity: σ ≥ 1/2, 1/2 ≤ J ≤ 8.

    With q = λ (J − 1) J each stretch is the larger root of 2μ̂ σ(σ − 1) = τ − q. One unknown is left,
    J = Π σ(q(J)). Newton's method finds it from J = 1, and halves its bracket where a step would leave it.

    Args:
        principal: [P, 3] principal Kirchhoff stresses [Pa]; mu, lam: [P] Lamé parameters [Pa].

    Returns:
        [P, 3]; NaN where there are no such stretches.
    """
    mu, lam = mu[:, None], lam[:, None]
    J, lower, upper = (np.full_like(mu, value) for value in (1.0, *_VOLUMES))
    for _ in range(_NEWTON_STEPS):
        root = np.sqrt(1.0 + 2.0 * (principal - lam * (J - 1.0) * J) / mu)  # 2σ − 1
        stretches = 0.5 * (1.0 + root)
        product = stretches.prod(1, keepdims=True)
        slope = (
            lam * (2.0 * J - 1.0) * product / (2.0 * mu) * (1.0 / (stretches * root)).sum(1, keepdims=True)
        )
        step = (product - J) / (1.0 + slope)
        # Where a root is not real the volume pushes too hard: J is too large if λ > 0, else too small.
        unreal = np.isnan(product)
        upper = np.where((product < J) | (unreal & (lam > 0.0)), J, upper)
        lower = np.where((product > J) | (unreal & (lam <= 0.0)), J, lower)
        inside = (J + step >= lower) & (J + step <= upper)
        J = np.where(inside, J + step, 0.5 * (lower + upper))
    return np.where(np.abs(step) < _CLOSED, stretches, np.nan)


@cache
def _functions(precision: Precision) -> LawFunctions:
    return LawFunctions(fixed_corotated_tau(precision), no_return_map(precision), no_params())


@dataclass(frozen=True)
class FixedCorotated(Material):
    """Elastic solid, ψ = μ̂ ‖F − R‖² + λ/2 (J − 1)²."""

    def functions(self, precision: Precision) -> LawFunctions:
        """The law's Warp functions."""
        return _functions(precision)

    def stretches_of(self, principal: np.ndarray, mu: np.ndarray, lam: np.ndarray) -> np.ndarray:
        """[P, 3] stretches, at least 1/2, of [P, 3] principal stresses, by Newton's method in J."""
        return fixed_corotated_stretches(principal, mu, lam)
