"""Transfers between particles and grid: P2G and G2P (paper section 3.3, steps 1 and 3).

One pair of kernels serves the full-order and the reduced solver: the reduced one
launches P2G over its integration particles and G2P over its sample particles.
"""

from dataclasses import dataclass
from functools import cache

import warp as wp

from nsf.errors import ConfigError
from nsf.mpm.grid import flat_index, inside, storage
from nsf.mpm.precision import Precision
from nsf.mpm.shape import DEGREES, shape_functions

SCHEMES = ("pic", "apic", "rpic")


@dataclass(frozen=True)
class Transfer:
    """How velocities travel between particles and grid.

    Attributes:
        scheme: `pic` carries no affine momentum; `apic` all of it; `rpic` its
            rotation, and of its symmetric part the share `1 − damping`.
        shape: B-spline, `quadratic` or `cubic`.
        damping: RPIC damping in [0, 1], dimensionless; 1 keeps rotation only.
        deterministic: on a GPU, sum P2G's contributions in a fixed order, so that the same run gives
            the same bits (slower); on a CPU that is so in any case.

    Raises:
        ConfigError: unknown scheme or shape; damping outside [0, 1] or not with RPIC.

    Source: Jiang et al. 2015 (APIC); Fang et al. 2019 (RPIC damping).
    """

    scheme: str = "apic"
    shape: str = "quadratic"
    damping: float = 0.0
    deterministic: bool = False

    def __post_init__(self):
        if self.scheme not in SCHEMES:
            raise ConfigError(
                f"transfer.scheme={self.scheme!r} is unknown; choose one of {', '.join(SCHEMES)}"
            )
        if self.shape not in DEGREES:
            raise ConfigError(f"transfer.shape={self.shape!r} is unknown; choose one of {', '.join(DEGREES)}")
        if not 0.0 <= self.damping <= 1.0:
            raise ConfigError(f"transfer.damping={self.damping} must lie in [0, 1]")
        if self.damping and self.scheme != "rpic":
            raise ConfigError(
                f"transfer.damping={self.damping} needs transfer.scheme=rpic, not {self.scheme}"
            )

    @property
    def affine_shares(self) -> tuple[float, float]:
        """Shares of the symmetric and of the skew part of C that are kept."""
        return {"pic": (0.0, 0.0), "apic": (1.0, 1.0), "rpic": (1.0 - self.damping, 1.0)}[self.scheme]


@cache
def make_p2g(precision: Precision, shape_name: str, deterministic: bool = False):
    """Kernel of P2G, one thread a particle.

    m_i = Σ_p w_ip m_p and, with the explicit force's impulse added in the same sweep,
    m_i v_i = Σ_p w_ip m_p (v_p + C_p (x_i − x_p)) − Δt Σ_p τ_p ∇w_ip V_p⁰.
    Particles off the grid are passed over; the solver's check reports them.

    Source: paper section 3.3, steps 1 and 2.
    """
    real, vec3, mat33 = precision.real, precision.vec3, precision.mat33
    shape = shape_functions(precision, shape_name)
    width = shape.degree + 1
    base_node, local, weights, gradients = shape.base_node, shape.local, shape.weights, shape.gradients
    options = {"max_unroll": 4}
    if deterministic:
        options |= {"deterministic": wp.DeterministicMode.RUN_TO_RUN, "deterministic_max_records": width**3}

    @wp.kernel(enable_backward=False, module="unique", module_options=options)
    def p2g(
        x: wp.array(dtype=vec3),
        v: wp.array(dtype=vec3),
        C: wp.array(dtype=mat33),
        tau: wp.array(dtype=mat33),
        mass: wp.array(dtype=real),
        volume0: wp.array(dtype=real),
        grid_shape: wp.vec3i,
        slots: wp.array(dtype=wp.int32),
        dx: real,
        dt: real,
        grid_mass: wp.array(dtype=real),
        grid_momentum: wp.array(dtype=vec3),
    ):
        p = wp.tid()
        inv_dx = real(1.0) / dx
        base = base_node(x[p], inv_dx)
        if not inside(base, width, grid_shape):
            return
        f = local(x[p], inv_dx, base)
        w = weights(f)
        d = gradients(f)
        m = mass[p]
        momentum = m * v[p]
        affine = (m * dx) * C[p]
        impulse = (-dt * volume0[p] * inv_dx) * tau[p]
        for a in range(width):
            for b in range(width):
                w_ab = w[0, a] * w[1, b]
                da_b = d[0, a] * w[1, b]
                a_db = w[0, a] * d[1, b]
                for c in range(width):
                    slot = storage(flat_index(base[0] + a, base[1] + b, base[2] + c, grid_shape), slots)
                    if slot >= 0:
                        weight = w_ab * w[2, c]
                        reach = vec3(real(float(a)) - f[0], real(float(b)) - f[1], real(float(c)) - f[2])
                        slope = vec3(da_b * w[2, c], a_db * w[2, c], w_ab * d[2, c])
                        wp.atomic_add(grid_mass, slot, weight * m)
                        wp.atomic_add(
                            grid_momentum, slot, weight * (momentum + affine * reach) + impulse * slope
                        )

    return p2g


@cache
def make_g2p(precision: Precision, shape_name: str):
    """Kernel of G2P, one thread a particle: new v, x, C and the deformation increment.

    v_p = Σ_i w_ip v_i, x_p ← x_p + Δt v_p, C_p = 12/(Δx²(b+1)) Σ_i w_ip v_i (x_i − x_p)ᵀ,
    f_p = I + Δt Σ_i v_i ∇w_ipᵀ, so that F_trial = f_p F_e.

    Source: paper section 3.3, step 3.
    """
    real, vec3, mat33 = precision.real, precision.vec3, precision.mat33
    shape = shape_functions(precision, shape_name)
    width = shape.degree + 1
    inverse_inertia = 1.0 / shape.affine_inertia
    base_node, local, weights, gradients = shape.base_node, shape.local, shape.weights, shape.gradients

    @wp.kernel(enable_backward=False, module="unique", module_options={"max_unroll": 4})
    def g2p(
        grid_velocity: wp.array(dtype=vec3),
        grid_shape: wp.vec3i,
        slots: wp.array(dtype=wp.int32),
        dx: real,
        dt: real,
        symmetric: real,
        skew: real,
        x: wp.array(dtype=vec3),
        v: wp.array(dtype=vec3),
        C: wp.array(dtype=mat33),
        increment: wp.array(dtype=mat33),
    ):
        p = wp.tid()
        inv_dx = real(1.0) / dx
        base = base_node(x[p], inv_dx)
        if not inside(base, width, grid_shape):
            return
        f = local(x[p], inv_dx, base)
        w = weights(f)
        d = gradients(f)
        velocity = vec3()
        affine = mat33()
        gradient = mat33()
        for a in range(width):
            for b in range(width):
                w_ab = w[0, a] * w[1, b]
                da_b = d[0, a] * w[1, b]
                a_db = w[0, a] * d[1, b]
                for c in range(width):
                    slot = storage(flat_index(base[0] + a, base[1] + b, base[2] + c, grid_shape), slots)
                    if slot >= 0:
                        weight = w_ab * w[2, c]
                        reach = vec3(real(float(a)) - f[0], real(float(b)) - f[1], real(float(c)) - f[2])
                        slope = vec3(da_b * w[2, c], a_db * w[2, c], w_ab * d[2, c])
                        v_i = grid_velocity[slot]
                        velocity += weight * v_i
                        affine += wp.outer(v_i, weight * reach)
                        gradient += wp.outer(v_i, slope)
        affine = (real(inverse_inertia) * inv_dx) * affine
        transposed = wp.transpose(affine)
        C[p] = real(0.5) * (symmetric * (affine + transposed) + skew * (affine - transposed))
        v[p] = velocity
        x[p] = x[p] + dt * velocity
        increment[p] = wp.identity(n=3, dtype=real) + (dt * inv_dx) * gradient

    return g2p
