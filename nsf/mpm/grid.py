"""The background grid: where nodes are stored, and the update of their velocities (paper section 3.3)."""

from dataclasses import dataclass
from functools import cache

import numpy as np
import warp as wp

from nsf.errors import ConfigError
from nsf.mpm.precision import Precision

# Kinds of contact. Sticky: no motion. Slip: no normal motion. Separate: no motion into the boundary.
STICKY, SLIP, SEPARATE = 0, 1, 2
# A node this near to a surface (in Δx) lies on it and belongs to the solid, in spite of round-off.
_ON_SURFACE = 1e-4
KINDS = {"sticky": STICKY, "slip": SLIP, "separate": SEPARATE}


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
    """Whether a stencil of `width` nodes an axis that starts at `base` lies on the grid."""
    return (
        base[0] >= 0
        and base[1] >= 0
        and base[2] >= 0
        and base[0] + width <= shape[0]
        and base[1] + width <= shape[1]
        and base[2] + width <= shape[2]
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
    in order: each half-space, then the walls of the domain. P2G has already added the
    force impulse to the momentum.

    Source: paper section 3.3, step 2; Coulomb friction: Stomakhin et al. 2013, section 8.
    """
    real, vec3 = precision.real, precision.vec3

    @wp.func
    def against_half_space(v: vec3, normal: vec3, kind: int, friction: real):
        if kind == wp.static(STICKY):
            return vec3()
        normal_speed = wp.dot(v, normal)
        if kind == wp.static(SEPARATE) and normal_speed >= real(0.0):
            return v
        tangential = v - normal_speed * normal
        speed = wp.length(tangential)
        slow_down = friction * wp.max(-normal_speed, real(0.0))
        if speed <= slow_down:
            return vec3()
        if speed > real(0.0):
            tangential = tangential * (real(1.0) - slow_down / speed)
        return tangential

    @wp.kernel(enable_backward=False, module="unique")
    def grid_update(
        mass: wp.array(dtype=real),
        momentum: wp.array(dtype=vec3),
        nodes: wp.array(dtype=wp.int32),
        shape: wp.vec3i,
        dx: real,
        dt: real,
        gravity: vec3,
        collider_point: wp.array(dtype=vec3),
        collider_normal: wp.array(dtype=vec3),
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
        for c in range(collider_kind.shape[0]):
            if wp.dot(x - collider_point[c], collider_normal[c]) <= real(wp.static(_ON_SURFACE)) * dx:
                v = against_half_space(v, collider_normal[c], collider_kind[c], collider_friction[c])
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
