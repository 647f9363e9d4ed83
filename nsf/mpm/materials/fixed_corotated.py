"""Fixed corotated elasticity."""

from dataclasses import dataclass
from functools import cache

import warp as wp

from nsf.mpm.materials.base import LawFunctions, Material, no_params, no_return_map
from nsf.mpm.precision import Precision


@cache
def fixed_corotated_tau(precision: Precision):
    """Warp function τ = 2μ̂ (F − R) Fᵀ + λ (J − 1) J I.

    Source: paper, appendix "Fixed corotated elasticity"; the identity is missing in print.
    """
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


@cache
def _functions(precision: Precision) -> LawFunctions:
    return LawFunctions(fixed_corotated_tau(precision), no_return_map(precision), no_params())


@dataclass(frozen=True)
class FixedCorotated(Material):
    """Elastic solid, ψ = μ̂ ‖F − R‖² + λ/2 (J − 1)²."""

    def functions(self, precision: Precision) -> LawFunctions:
        """The law's Warp functions."""
        return _functions(precision)
