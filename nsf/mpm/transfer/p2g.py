"""P2G: mass, momentum and impulse of the particles → nodes (paper section 3.3, step 1).

The full-order and the reduced solver share it. The reduced solver launches it over its integration particles.
"""

from functools import cache

import warp as wp

from nsf.mpm.batch import make_runs
from nsf.mpm.grid.nodes import flat_index, inside, storage
from nsf.mpm.grid.shape import shape_functions
from nsf.mpm.native.access import WARP
from nsf.mpm.precision import Precision
from nsf.mpm.transfer.scatter import any_of_warp, make_scatter


@cache
def make_p2g(
    precision: Precision,
    shape_name: str,
    deterministic: bool = False,
    batch: bool = False,
    by_warp: bool = False,
):
    """Kernel of P2G, launched over whole warps. The first `each` threads of a warp have a particle.

    m_i = Σ_p w_ip m_p and, with the explicit force's impulse added in the same sweep,
    m_i v_i = Σ_p w_ip m_p (v_p + C_p (x_i − x_p)) − Δt Σ_p τ_p ∇w_ip V_p⁰.
    Particles off the grid are passed over; the solver's check reports them. With `batch`, rows of particles
    and nodes are those of `runs` runs. `by_warp` is for a GPU: the threads of a warp share the nodes
    of the warp's particles (`make_scatter`). They add up the contributions of one cell before these reach
    memory, in no fixed order. `by_warp` excludes `deterministic`.

    Source: paper section 3.3, steps 1 and 2.
    """
    real, vec3, vec4, mat33 = precision.real, precision.vec3, precision.vec4, precision.mat33
    shape = shape_functions(precision, shape_name)
    width = shape.degree + 1
    base_node, local, weights, gradients = shape.base_node, shape.local, shape.weights, shape.gradients
    share, run_of = make_runs(batch)
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
        runs: int,
        values: wp.array(dtype=vec4),
        each: int,
    ):
        lane = wp.tid() % WARP
        # A thread without a particle reads its neighbour's particle.
        t = wp.tid() / WARP * each + wp.min(lane, each - 1)
        p = wp.min(t, x.shape[0] - 1)
        run = run_of(p, share(x.shape[0], runs))
        start = run * share(values.shape[0], runs)
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
