"""G2P: velocities of the nodes → particles, with the constitutive update (paper section 3.3, step 3).

The reduced solver's G2P for few sample particles is in `nsf.mpm.step`; it needs neither C nor the
deformation increment.
"""

from functools import cache

import warp as wp

from nsf.mpm.grid.nodes import flat_index, inside, storage
from nsf.mpm.grid.shape import shape_functions
from nsf.mpm.materials.base import LawFunctions, make_law_update
from nsf.mpm.native.access import make_load
from nsf.mpm.precision import Precision


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
