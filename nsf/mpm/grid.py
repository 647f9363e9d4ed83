"""The background grid: where nodes are stored, and the update of their velocities (paper section 3.3)."""

from dataclasses import dataclass
from functools import cache

import numpy as np
import warp as wp

from nsf.errors import ConfigError
from nsf.mpm.contact import SLIP, STICKY, make_contact
from nsf.mpm.precision import Precision


@dataclass(frozen=True)
class GridGeometry:
    """A box of nodes x_i = dx·(i, j, k) that starts at the origin.

    Attributes:
        dx: spacing [m].
        nodes: number of nodes an axis.
    """

    dx: float
    nodes: tuple[int, int, int]

    @classmethod
    def of_domain(cls, size: tuple[float, float, float], dx: float) -> "GridGeometry":
        """Grid that covers [0, size].

        Args:
            size: domain edge lengths [m].
            dx: spacing [m].

        Raises:
            ConfigError: the spacing is not positive or leaves fewer than 8 cells an axis.
        """
        if not dx > 0:
            raise ConfigError(f"dx={dx} m must be positive")
        cells = tuple(int(np.ceil(edge / dx - 1e-9)) for edge in size)
        if min(cells) < 8:
            raise ConfigError(
                f"dx={dx} m leaves {min(cells)} cells across the domain {tuple(size)} m; choose a smaller dx"
            )
        return cls(float(dx), tuple(c + 1 for c in cells))

    @property
    def count(self) -> int:
        """Number of nodes."""
        return int(np.prod(self.nodes))

    @property
    def upper(self) -> tuple[float, float, float]:
        """Position of the last node [m]."""
        return tuple((n - 1) * self.dx for n in self.nodes)


class Grid:
    """Mass and momentum (then velocity) of the grid's nodes, on one device.

    Stored for every node of the box, or only for the nodes listed (a reduced model
    touches few). The kernels find a node's storage through `slots`.

    Attributes:
        geometry: spacing and node counts.
        mass: [n] m_i [kg].
        momentum: [n, 3] m_i v_i [kg m/s] after P2G, v_i [m/s] after the update.
        nodes: [n] flat node index of each stored node; empty when every node is stored.
        slots: [all nodes] storage index or −1; empty when every node is stored.
    """

    def __init__(self, geometry: GridGeometry, precision: Precision, device, nodes: np.ndarray | None = None):
        self.geometry = geometry
        self.sparse = nodes is not None
        count = len(nodes) if self.sparse else geometry.count
        slots = np.zeros(0, np.int32)
        if self.sparse:
            slots = np.full(geometry.count, -1, np.int32)
            slots[nodes] = np.arange(count, dtype=np.int32)
        self.nodes = wp.array(nodes if self.sparse else np.zeros(0), dtype=wp.int32, device=device)
        self.slots = wp.array(slots, dtype=wp.int32, device=device)
        self.shape = wp.vec3i(*geometry.nodes)
        self.mass = wp.zeros(count, dtype=precision.real, device=device)
        self.momentum = wp.zeros(count, dtype=precision.vec3, device=device)

    @property
    def count(self) -> int:
        """Number of stored nodes."""
        return self.mass.shape[0]

    @property
    def nbytes(self) -> int:
        """Bytes on the device."""
        return sum(a.capacity for a in (self.mass, self.momentum, self.nodes, self.slots))

    def clear(self) -> None:
        """Zero mass and momentum."""
        self.mass.zero_()
        self.momentum.zero_()


@wp.func
def flat_index(i: int, j: int, k: int, shape: wp.vec3i):
    """Flat index of node (i, j, k)."""
    return (i * shape[1] + j) * shape[2] + k


@wp.func
def node_of(flat: int, shape: wp.vec3i):
    """Node (i, j, k) of a flat index."""
    return wp.vec3i(flat / (shape[1] * shape[2]), (flat / shape[2]) % shape[1], flat % shape[2])


@wp.func
def inside(base: wp.vec3i, width: int, shape: wp.vec3i):
    """Whether a stencil of `width` nodes an axis that starts at `base` lies on the grid.

    `base` may be any integer: a GPU gives a position far away the largest one, to which nothing can be added.
    """
    return (
        base[0] >= 0
        and base[1] >= 0
        and base[2] >= 0
        and base[0] <= shape[0] - width
        and base[1] <= shape[1] - width
        and base[2] <= shape[2] - width
    )


@wp.func
def storage(flat: int, slots: wp.array(dtype=wp.int32)):
    """Storage index of a node, −1 when it is not stored."""
    slot = flat
    if slots.shape[0] > 0:
        slot = slots[flat]
    return slot


@cache
def make_grid_update(precision: Precision):
    """Kernel of the grid update: momentum → velocity, gravity, walls, colliders.

    v_i = (m_i v_i − Δt Σ_p τ_p ∇w_ip V_p⁰)/m_i + Δt g, then the boundary conditions
    in order: each collider that acts, then the walls of the domain. P2G has already added
    the force impulse to the momentum. A node belongs to a solid by the solid's pose at t^n, the
    time of the particles that P2G took here, and v_i^{n+1} meets the condition relative to the
    solid's mean velocity over the step (`make_follow`). Frames that move by whole cells a step
    thus see the same contact.

    Source: paper section 3.3, step 2.
    """
    real, vec3, mat33 = precision.real, precision.vec3, precision.mat33
    outward_normal, against = make_contact(precision)

    @wp.kernel(enable_backward=False, module="unique")
    def grid_update(
        mass: wp.array(dtype=real),
        momentum: wp.array(dtype=vec3),
        nodes: wp.array(dtype=wp.int32),
        shape: wp.vec3i,
        dx: real,
        dt: real,
        gravity: vec3,
        collider_shape: wp.array(dtype=wp.int32),
        collider_active: wp.array(dtype=wp.int32),
        collider_position: wp.array(dtype=vec3),
        collider_orientation: wp.array(dtype=mat33),
        collider_extents: wp.array(dtype=vec3),
        collider_velocity: wp.array(dtype=vec3),
        collider_gradient: wp.array(dtype=mat33),
        collider_kind: wp.array(dtype=wp.int32),
        collider_friction: wp.array(dtype=real),
        wall_kind: int,
        wall_padding: int,
    ):
        slot = wp.tid()
        m = mass[slot]
        if m <= real(0.0):
            return
        flat = slot
        if nodes.shape[0] > 0:
            flat = nodes[slot]
        node = node_of(flat, shape)
        v = momentum[slot] / m + dt * gravity
        x = dx * vec3(real(node[0]), real(node[1]), real(node[2]))
        for c in range(collider_shape.shape[0]):
            if collider_active[c] != 0:
                arm = x - collider_position[c]
                normal = outward_normal(
                    collider_shape[c], arm, collider_orientation[c], collider_extents[c], dx
                )
                if wp.length_sq(normal) > real(0.0):
                    solid = collider_velocity[c] + collider_gradient[c] * arm
                    v = solid + against(v - solid, normal, collider_kind[c], collider_friction[c])
        for axis in range(3):
            low = node[axis] < wall_padding
            high = node[axis] >= shape[axis] - wall_padding
            if low or high:
                if wall_kind == wp.static(STICKY):
                    v = vec3()
                elif (
                    wall_kind == wp.static(SLIP)
                    or (low and v[axis] < real(0.0))
                    or (high and v[axis] > real(0.0))
                ):
                    v[axis] = real(0.0)
        momentum[slot] = v

    return grid_update
