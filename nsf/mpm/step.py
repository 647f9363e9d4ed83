"""P2G, grid update and G2P: the part of a step that the full-order and the reduced solver share.

The update, momentum → velocity at the nodes (paper section 3.3, step 2), is here; the transfers are in
`nsf.mpm.transfer`.
"""

from functools import cache

import warp as wp

from nsf.errors import ConfigError
from nsf.mpm.batch import make_runs
from nsf.mpm.boundaries.arrays import make_solids
from nsf.mpm.boundaries.contact import SLIP, STICKY, make_contact
from nsf.mpm.forcing import Forcing
from nsf.mpm.grid.nodes import (
    Grid,
    flat_index,
    inside,
    make_reach,
    node_of,
    node_of_step,
    nodes_of_step,
    storage,
)
from nsf.mpm.grid.shape import shape_functions
from nsf.mpm.native.access import WARP, make_load, make_warp_sum
from nsf.mpm.precision import Precision
from nsf.mpm.stability import check_colliders
from nsf.mpm.transfer.g2p import make_g2p
from nsf.mpm.transfer.p2g import make_p2g
from nsf.mpm.transfer.scatter import THREADS, particles_of_warp
from nsf.mpm.transfer.scheme import Transfer


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


class GridStep:
    """P2G, grid update and G2P over given particle arrays.

    Both solvers have one P2G, and one rule by which a node's momentum becomes its velocity. `update` and
    `g2p` move every particle. `update_g2p` moves few particles to the same places. A reduced step is
    therefore the full-order step on fewer particles. On a grid of a batch, `p2g` and `update_g2p` do the
    work of all its runs, and arrays of particles hold equally many rows of each.

    Args:
        grid: the nodes.
        forcing: gravity, colliders and walls, of all its runs.
        transfer: transfer scheme and B-spline.
        dt: step [s].
        precision: floating-point types.
        device: Warp device.

    Raises:
        ConfigError: the grid does not resolve a collider.
        InstabilityError: a collider crosses more than a cell in a step.
    """

    def __init__(self, grid: Grid, forcing: Forcing, transfer: Transfer, dt, precision, device):
        real = precision.real
        check_colliders(forcing.boundaries.colliders, grid.geometry, dt)
        self.grid, self.device = grid, device
        self.dx, self.dt = real(grid.geometry.dx), real(dt)
        self._seconds = float(dt)  # the forcing's time is fp64 in either precision
        batch = grid.runs > 1
        self.forcing = forcing
        self.affine_shares = tuple(real(s) for s in transfer.affine_shares)
        self._by_warp = device.is_cuda and not transfer.deterministic
        self._p2g = make_p2g(precision, transfer.shape, transfer.deterministic, batch, self._by_warp)
        self._g2p = make_g2p(precision, transfer.shape)
        self._reach = make_reach(precision, transfer.shape)
        self._update = make_grid_update(precision)
        self._update_g2p = make_update_g2p(precision, transfer.shape, batch)

    def p2g(self, x, v, C, tau, mass, volume0) -> None:
        """Particles → grid: mass, momentum and the impulse of the stress.

        Args:
            x, v: [n] position [m] and velocity [m/s].
            C: [n] affine momentum [1/s].
            tau: [n] Kirchhoff stress [Pa].
            mass, volume0: [n] mass [kg] and volume at rest [m³].
        """
        self.clear(x)
        self.scatter(x, v, C, tau, mass, volume0)

    def clear(self, x) -> None:
        """Zero the nodes of the last step and list the blocks that particles at x [n] [m] reach."""
        grid = self.grid
        grid.clear()
        if not grid.sparse:
            inputs = [x, grid.shape, grid.block_shape, self.dx, grid.marks, grid.blocks, grid.listed]
            wp.launch(self._reach, dim=x.shape[0], inputs=inputs, device=self.device)

    def scatter(self, x, v, C, tau, mass, volume0) -> None:
        """Add mass, momentum and impulse of the particles to cleared nodes; arguments as for `p2g`."""
        grid, each = self.grid, particles_of_warp(x.shape[0]) if self._by_warp else WARP
        inputs = [
            x,
            v,
            C,
            tau,
            mass,
            volume0,
            grid.shape,
            grid.slots,
            self.dx,
            self.dt,
            grid.runs,
            grid.values,
            each,
        ]
        wp.launch(
            self._p2g, dim=-(-x.shape[0] // each) * WARP, inputs=inputs, device=self.device, block_dim=THREADS
        )

    def follow(self) -> None:
        """Move the forcing on by a step. `update` calls this; `update_g2p` does not."""
        self.forcing.advance(self._seconds)

    def update(self) -> None:
        """Momentum → velocity at the next time level with all boundaries, which then move by a step.

        Raises:
            ConfigError: the grid is of a batch; use `update_g2p` for it.
        """
        if self.grid.runs > 1:
            raise ConfigError(f"a grid of {self.grid.runs} runs is not updated as a whole; use update_g2p")
        self.follow()
        inputs = [*self.grid.stored, *self._updating]
        wp.launch(self._update, dim=self.grid.threads, inputs=inputs, device=self.device)

    def g2p(self, x, v, C, increment) -> None:
        """Grid → particles, after `update`: velocity, position, affine momentum, deformation increment."""
        inputs = [*self.gathering, x, v, C, increment]
        wp.launch(self._g2p, dim=C.shape[0], inputs=inputs, device=self.device)

    def update_g2p(self, x, v, moved: int) -> None:
        """Find v and x of the first particles of each run, in place of `update` and `g2p`.

        Only the nodes of these particles are updated, on the way. The grid keeps its momenta.

        Args:
            x, v: [n] position [m] and velocity [m/s] that P2G took.
            moved: number of particles to move in each run.
        """
        lanes, grid = WARP if self.device.is_cuda else 1, self.grid
        inputs = [grid.shape, grid.slots, moved, lanes, grid.runs, x, v, *self._updating]
        wp.launch(self._update_g2p, dim=grid.runs * moved * lanes, inputs=inputs, device=self.device)

    @property
    def _updating(self) -> list:
        """Arguments of the nodes' velocity, in the kernels' order."""
        grid = self.grid
        return [grid.values, self.dx, self.dt, self.forcing.now, self.forcing.boundaries.solids]

    @property
    def gathering(self) -> list:
        """Arguments of G2P, in the kernels' order."""
        grid = self.grid
        return [grid.values, grid.shape, grid.slots, self.dx, self.dt, *self.affine_shares]
