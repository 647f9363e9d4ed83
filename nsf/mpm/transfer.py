"""Transfers between particles and grid: P2G and G2P (paper section 3.3, steps 1 and 3).

The full-order and the reduced solver share one P2G. The reduced solver launches it over its integration
particles. Its G2P for few sample particles is in `update.py` and needs neither C nor the deformation
increment.
"""

from dataclasses import dataclass
from functools import cache

import warp as wp

from nsf.errors import ConfigError
from nsf.mpm.access import WARP, make_load
from nsf.mpm.copies import make_copies
from nsf.mpm.grid import flat_index, inside, storage
from nsf.mpm.materials import LawFunctions, make_law_update
from nsf.mpm.precision import Precision
from nsf.mpm.scatter import any_of_warp, make_scatter
from nsf.mpm.shape import DEGREES, shape_functions

SCHEMES = ("pic", "apic", "rpic")


@dataclass(frozen=True)
class Transfer:
    """How velocities travel between particles and grid.

    Attributes:
        scheme: `pic` carries no affine momentum; `apic` carries all of it; `rpic` carries its
            rotation, and the share `1 − damping` of its symmetric part.
        shape: B-spline, `quadratic` or `cubic`.
        damping: RPIC damping in [0, 1], dimensionless; 1 keeps rotation only.
        deterministic: on a GPU, sum P2G's contributions in a fixed order, so that the same run gives
            the same bits (slower). A CPU always does.

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
def make_p2g(
    precision: Precision,
    shape_name: str,
    deterministic: bool = False,
    several: bool = False,
    by_warp: bool = False,
):
    """Kernel of P2G, launched over whole warps. The first `each` threads of a warp have a particle.

    m_i = Σ_p w_ip m_p and, with the explicit force's impulse added in the same sweep,
    m_i v_i = Σ_p w_ip m_p (v_p + C_p (x_i − x_p)) − Δt Σ_p τ_p ∇w_ip V_p⁰.
    Particles off the grid are passed over; the solver's check reports them. With `several`, rows of particles
    and nodes are those of `copies` simulations. `by_warp` is for a GPU: the threads of a warp share the nodes
    of the warp's particles (`make_scatter`). They add up the contributions of one cell before these reach
    memory, in no fixed order. `by_warp` excludes `deterministic`.

    Source: paper section 3.3, steps 1 and 2.
    """
    real, vec3, vec4, mat33 = precision.real, precision.vec3, precision.vec4, precision.mat33
    shape = shape_functions(precision, shape_name)
    width = shape.degree + 1
    base_node, local, weights, gradients = shape.base_node, shape.local, shape.weights, shape.gradients
    share, copy_of = make_copies(several)
    scatter = make_scatter(precision, width)
    options = {"max_unroll": 4}
    if deterministic:
        options |= {"deterministic": wp.DeterministicMode.RUN_TO_RUN, "deterministic_max_records": width**3}

    @wp.kernel(enable_backward=False, module="unique", module_options=options, grid_stride=False)
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
        copies: int,
        values: wp.array(dtype=vec4),
        each: int,
    ):
        lane = wp.tid() % WARP
        # A thread without a particle reads its neighbour's particle.
        t = wp.tid() / WARP * each + wp.min(lane, each - 1)
        p = wp.min(t, x.shape[0] - 1)
        copy = copy_of(p, share(x.shape[0], copies))
        start = copy * share(values.shape[0], copies)
        inv_dx = real(1.0) / dx
        base = base_node(x[p], inv_dx)
        cell = -1
        if lane < each and t < x.shape[0] and inside(base, width, grid_shape):
            cell = flat_index(base[0], base[1], base[2], grid_shape)
        if wp.static(by_warp):
            if not any_of_warp(cell >= 0):
                return
        elif cell < 0:
            return
        f = local(x[p], inv_dx, base)
        w = weights(f)
        d = gradients(f)
        m = mass[p]
        affine = (m * dx) * C[p]
        momentum = m * v[p] - affine * f  # at the first node
        impulse = (-dt * volume0[p] * inv_dx) * tau[p]
        if wp.static(by_warp):
            scatter(cell, start, w, d, m, momentum, affine, impulse, grid_shape, slots, values)
        else:
            for a in range(width):
                for b in range(width):
                    w_ab = w[0, a] * w[1, b]
                    da_b = d[0, a] * w[1, b]
                    a_db = w[0, a] * d[1, b]
                    for c in range(width):
                        weight = w_ab * w[2, c]
                        node = vec3(real(float(a)), real(float(b)), real(float(c)))
                        slope = vec3(da_b * w[2, c], a_db * w[2, c], w_ab * d[2, c])
                        carried = weight * (momentum + affine * node) + impulse * slope
                        slot = storage(cell + flat_index(a, b, c, grid_shape), slots)
                        if slot >= 0:
                            added = vec4(carried[0], carried[1], carried[2], weight * m)
                            wp.atomic_add(values, start + slot, added)

    return p2g


@cache
def make_gather(precision: Precision, shape_name: str):
    """Warp function of G2P: v_p, C_p and the deformation increment f_p from a particle's nodes.

    v_p = Σ_i w_ip v_i, x_p ← x_p + Δt v_p, C_p = 12/(Δx²(b+1)) Σ_i w_ip v_i (x_i − x_p)ᵀ,
    f_p = I + Δt Σ_i v_i ∇w_ipᵀ, so that F_trial = f_p F_e.

    Source: paper section 3.3, step 3.
    """
    real, vec3, vec4, mat33 = precision.real, precision.vec3, precision.vec4, precision.mat33
    shape = shape_functions(precision, shape_name)
    width = shape.degree + 1
    inverse_inertia = 1.0 / shape.affine_inertia
    local, weights, gradients = shape.local, shape.weights, shape.gradients
    load = make_load(precision)

    @wp.func
    def gather(
        x: vec3,
        base: wp.vec3i,
        values: wp.array(dtype=vec4),
        grid_shape: wp.vec3i,
        slots: wp.array(dtype=wp.int32),
        dx: real,
        dt: real,
        symmetric: real,
        skew: real,
    ):
        inv_dx = real(1.0) / dx
        f = local(x, inv_dx, base)
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
                    weight = w_ab * w[2, c]
                    reach = vec3(real(float(a)) - f[0], real(float(b)) - f[1], real(float(c)) - f[2])
                    slope = vec3(da_b * w[2, c], a_db * w[2, c], w_ab * d[2, c])
                    # Without a branch, so that the loads of all nodes are under way together.
                    value = wp.where(slot >= 0, load(values, wp.max(slot, 0)), vec4())
                    v_i = vec3(value[0], value[1], value[2])
                    velocity += weight * v_i
                    affine += wp.outer(v_i, weight * reach)
                    gradient += wp.outer(v_i, slope)
        affine = (real(inverse_inertia) * inv_dx) * affine
        transposed = wp.transpose(affine)
        C = real(0.5) * (symmetric * (affine + transposed) + skew * (affine - transposed))
        return velocity, C, wp.identity(n=3, dtype=real) + (dt * inv_dx) * gradient

    return gather


@cache
def make_g2p(precision: Precision, shape_name: str):
    """Kernel of G2P, one thread a particle: new v, x, C and the deformation increment.

    Source: paper section 3.3, step 3.
    """
    real, vec3, vec4, mat33 = precision.real, precision.vec3, precision.vec4, precision.mat33
    shape = shape_functions(precision, shape_name)
    base_node, width = shape.base_node, shape.degree + 1
    gather = make_gather(precision, shape_name)

    @wp.kernel(enable_backward=False, module="unique", module_options={"max_unroll": 4})
    def g2p(
        values: wp.array(dtype=vec4),
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
        base = base_node(x[p], real(1.0) / dx)
        if not inside(base, width, grid_shape):
            return
        velocity, affine, f = gather(x[p], base, values, grid_shape, slots, dx, dt, symmetric, skew)
        v[p] = velocity
        x[p] = x[p] + dt * velocity
        C[p] = affine
        increment[p] = f

    return g2p


@cache
def make_g2p_stress(precision: Precision, shape_name: str, law: LawFunctions, history_size: int):
    """Kernel of G2P and the constitutive update in one pass, so that f_p never reaches memory.

    It equals `make_g2p` followed by `make_stress_update`.

    Source: paper section 3.3, step 3.
    """
    real, vec3, vec4, mat33 = precision.real, precision.vec3, precision.vec4, precision.mat33
    shape = shape_functions(precision, shape_name)
    base_node, width = shape.base_node, shape.degree + 1
    gather = make_gather(precision, shape_name)
    law_update, Params = make_law_update(law, precision, history_size), law.Params
    vecH = wp.types.vector(length=history_size, dtype=real)

    @wp.kernel(enable_backward=False, module="unique", module_options={"max_unroll": 4})
    def g2p_stress(
        values: wp.array(dtype=vec4),
        grid_shape: wp.vec3i,
        slots: wp.array(dtype=wp.int32),
        dx: real,
        dt: real,
        symmetric: real,
        skew: real,
        mu: wp.array(dtype=real),
        lam: wp.array(dtype=real),
        params: Params,
        x: wp.array(dtype=vec3),
        v: wp.array(dtype=vec3),
        C: wp.array(dtype=mat33),
        F_e: wp.array(dtype=mat33),
        history: wp.array(dtype=vecH),
        tau: wp.array(dtype=mat33),
    ):
        p = wp.tid()
        base = base_node(x[p], real(1.0) / dx)
        if not inside(base, width, grid_shape):
            return
        velocity, affine, f = gather(x[p], base, values, grid_shape, slots, dx, dt, symmetric, skew)
        v[p] = velocity
        x[p] = x[p] + dt * velocity
        C[p] = affine
        F, h, stress = law_update(f * F_e[p], history[p], mu[p], lam[p], params, dt)
        F_e[p] = F
        history[p] = h
        tau[p] = stress

    return g2p_stress
