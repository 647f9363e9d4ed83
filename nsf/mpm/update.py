"""Momentum → velocity at the nodes (paper section 3.3, step 2), everywhere or where few particles need it."""

from functools import cache

import warp as wp

from nsf.mpm.batch import make_runs
from nsf.mpm.boundaries.arrays import make_solids
from nsf.mpm.boundaries.contact import SLIP, STICKY, make_contact
from nsf.mpm.grid.nodes import flat_index, inside, node_of, node_of_step, nodes_of_step, storage
from nsf.mpm.grid.shape import shape_functions
from nsf.mpm.native.access import make_load, make_warp_sum
from nsf.mpm.precision import Precision


@cache
def make_node_velocity(precision: Precision):
    """Warp function (values of a node, node, ...) → its velocity. The node must have mass. `fall` is Δt g.

    v_i = (m_i v_i − Δt Σ_p τ_p ∇w_ip V_p⁰)/m_i + Δt g, then the boundary conditions
    in order: each collider that acts, then the walls of the domain. P2G has already added
    the force impulse to the momentum. The solid's pose at t^n decides whether a node belongs to the
    solid, because t^n is the time of the particles of P2G. v_i^{n+1} meets the condition relative to
    the solid's mean velocity over the step (`make_follow`). Frames that move by whole cells a step
    thus see the same contact. The solids from `first` up to `end` are those of the node's simulation.

    Source: paper section 3.3, step 2.
    """
    real, vec3, vec4 = precision.real, precision.vec3, precision.vec4
    outward_normal, against = make_contact(precision)
    Solids = make_solids(precision)

    @wp.func
    def node_velocity(
        value: vec4,
        node: wp.vec3i,
        shape: wp.vec3i,
        dx: real,
        fall: vec3,
        first: int,
        end: int,
        solids: Solids,
    ):
        v = vec3(value[0], value[1], value[2]) / value[3] + fall
        x = dx * vec3(real(node[0]), real(node[1]), real(node[2]))
        for c in range(first, end):
            if solids.active[c] != 0:
                arm = x - solids.position[c]
                normal = outward_normal(solids.shape[c], arm, solids.orientation[c], solids.extents[c], dx)
                if wp.length_sq(normal) > real(0.0):
                    solid = solids.velocity[c] + solids.gradient[c] * arm
                    v = solid + against(v - solid, normal, solids.kind[c], solids.friction[c])
        for axis in range(3):
            low = node[axis] < solids.wall_padding
            high = node[axis] >= shape[axis] - solids.wall_padding
            if low or high:
                if solids.wall_kind == wp.static(STICKY):
                    v = vec3()
                elif (
                    solids.wall_kind == wp.static(SLIP)
                    or (low and v[axis] < real(0.0))
                    or (high and v[axis] > real(0.0))
                ):
                    v[axis] = real(0.0)
        return v

    return node_velocity


@cache
def make_grid_update(precision: Precision):
    """Kernel of the grid update: momentum → velocity at every node of a step, see `make_node_velocity`.

    Source: paper section 3.3, step 2.
    """
    real, vec3, vec4 = precision.real, precision.vec3, precision.vec4
    node_velocity, load = make_node_velocity(precision), make_load(precision)
    Solids = make_solids(precision)

    @wp.kernel(enable_backward=False, module="unique")
    def grid_update(
        nodes: wp.array(dtype=wp.int32),
        slots: wp.array(dtype=wp.int32),
        blocks: wp.array(dtype=wp.int32),
        listed: wp.array(dtype=wp.int32),
        shape: wp.vec3i,
        block_shape: wp.vec3i,
        threads: int,
        values: wp.array(dtype=vec4),
        dx: real,
        dt: real,
        gravity: wp.array(dtype=vec3),
        solids: Solids,
    ):
        index = wp.tid()
        count = nodes_of_step(nodes, listed)
        end = solids.kind.shape[0]
        while index < count:
            flat = node_of_step(index, nodes, blocks, shape, block_shape)
            index += threads
            slot = 0
            value = vec4()
            if flat >= 0:
                slot = storage(flat, slots)
                value = load(values, slot)
            if value[3] > real(0.0):
                node = node_of(flat, shape)
                v = node_velocity(value, node, shape, dx, dt * gravity[0], 0, end, solids)
                values[slot] = vec4(v[0], v[1], v[2], value[3])

    return grid_update


@cache
def make_update_g2p(precision: Precision, shape_name: str, batch: bool = False):
    """Kernel of v and x after a step for few particles, from nodes that still hold momenta.

    It gives v and x of `make_grid_update` and `make_g2p` in one pass, without C and the increment. `lanes`
    threads (a warp, or one) share the nodes of a particle's stencil and update each node on the way. The grid
    is not written. With `batch`, arrays are those of `runs` runs, and the first `moved` particles of each are
    moved.

    Source: paper section 3.3, steps 2 and 3.
    """
    real, vec3, vec4 = precision.real, precision.vec3, precision.vec4
    shape = shape_functions(precision, shape_name)
    base_node, local, weights, entry = shape.base_node, shape.local, shape.weights, shape.entry
    width = shape.degree + 1
    node_velocity, load = make_node_velocity(precision), make_load(precision)
    total = make_warp_sum(precision)
    share, run_of = make_runs(batch)
    Solids = make_solids(precision)

    @wp.kernel(enable_backward=False, module="unique", grid_stride=False)
    def update_g2p(
        grid_shape: wp.vec3i,
        slots: wp.array(dtype=wp.int32),
        moved: int,
        lanes: int,
        runs: int,
        x: wp.array(dtype=vec3),
        v: wp.array(dtype=vec3),
        values: wp.array(dtype=vec4),
        dx: real,
        dt: real,
        gravity: wp.array(dtype=vec3),
        solids: Solids,
    ):
        t = wp.tid() / lanes
        run = run_of(t, moved)
        p = t + run * (share(x.shape[0], runs) - moved)
        start = run * share(values.shape[0], runs)
        count_of_solids = share(solids.kind.shape[0], runs)
        first = run * count_of_solids
        fall = dt * gravity[run]
        at = x[p]
        inv_dx = real(1.0) / dx
        base = base_node(at, inv_dx)
        if not inside(base, width, grid_shape):
            return
        w = weights(local(at, inv_dx, base))
        velocity = vec3()
        n = wp.tid() % lanes
        while n < wp.static(width**3):
            a, b, c = n / wp.static(width**2), n / width % width, n % width
            n += lanes
            node = base + wp.vec3i(a, b, c)
            slot = storage(flat_index(node[0], node[1], node[2], grid_shape), slots)
            # Without a branch, so that a solid's data is under way together with the node's.
            value = wp.where(slot >= 0, load(values, start + wp.max(slot, 0)), vec4())
            v_i = node_velocity(value, node, grid_shape, dx, fall, first, first + count_of_solids, solids)
            if value[3] > real(0.0):
                velocity += entry(w, 0, a) * entry(w, 1, b) * entry(w, 2, c) * v_i
        velocity = total(velocity, lanes)
        if wp.tid() % lanes == 0:
            v[p] = velocity
            x[p] = at + dt * velocity

    return update_g2p
