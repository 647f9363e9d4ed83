"""The background grid: the storage of its nodes, and the nodes that a step works on (paper section 3.3)."""

from functools import cache

import numpy as np
import warp as wp

from nsf.errors import ConfigError
from nsf.mpm.grid.geometry import BLOCK, GridGeometry
from nsf.mpm.grid.shape import shape_functions
from nsf.mpm.precision import Precision

_BLOCK_NODES = BLOCK**3
# Threads that share the nodes of the listed blocks: enough to fill a GPU, too few to be noticed.
_THREADS = {"cuda": 2**17, "cpu": _BLOCK_NODES}


class Grid:
    """Momentum (then velocity) and mass of the grid's nodes, on one device.

    A grid stores every node of the box, or only a list of nodes, since a reduced model touches
    few. The kernels find a node's storage through `slots`.

    If every node is stored, a step clears and updates only the blocks of 4³ nodes that particles
    reach. The device finds these blocks, so that a captured step finds them anew. All other nodes
    stay zero.

    Args:
        geometry: spacing and node counts.
        precision, device: of the values.
        nodes: flat indices of the nodes to store; all by default.
        runs: number of runs of a batch, each with values of its own at these nodes.

    Attributes:
        geometry, runs: as given.
        values: [runs n, 4] m_i v_i [kg m/s] after P2G, v_i [m/s] after the update; last m_i [kg].
        nodes: [n] flat node index of each stored node; empty when every node is stored.
        slots: [all nodes] storage index or −1; empty when every node is stored.
        marks: [all blocks] 1 for a block that particles reach; empty for a list of nodes, as the next two.
        blocks: [all blocks] flat indices of the reached blocks, in any order.
        listed: [1] number of reached blocks.

    Raises:
        ConfigError: a batch on a grid that stores every node.
    """

    def __init__(
        self,
        geometry: GridGeometry,
        precision: Precision,
        device,
        nodes: np.ndarray | None = None,
        runs: int = 1,
    ):
        self.geometry, self.runs = geometry, runs
        self.sparse = nodes is not None
        if runs > 1 and not self.sparse:
            raise ConfigError(f"{runs} runs on one grid need a list of nodes; use integration=superset")
        count = len(nodes) if self.sparse else geometry.count
        slots = np.zeros(0, np.int32)
        if self.sparse:
            slots = np.full(geometry.count, -1, np.int32)
            slots[nodes] = np.arange(count, dtype=np.int32)
        self.nodes = wp.array(nodes if self.sparse else np.zeros(0), dtype=wp.int32, device=device)
        self.slots = wp.array(slots, dtype=wp.int32, device=device)
        self.shape = wp.vec3i(*geometry.nodes)
        self.values = wp.zeros(runs * count, dtype=precision.vec4, device=device)
        blocks = 0 if self.sparse else int(np.prod(geometry.blocks))
        self.block_shape = wp.vec3i(*geometry.blocks)
        self.marks, self.blocks = (wp.zeros(blocks, dtype=wp.int32, device=device) for _ in range(2))
        self.listed = wp.zeros(min(blocks, 1), dtype=wp.int32, device=device)
        most = _THREADS["cuda" if self.values.device.is_cuda else "cpu"]
        #: Threads of a kernel over the nodes of a step.
        self.threads = count if self.sparse else min(blocks * _BLOCK_NODES, most)
        self._precision = precision
        self._clear = make_clear(precision)

    @property
    def count(self) -> int:
        """Number of stored nodes of a run."""
        return self.values.shape[0] // self.runs

    @property
    def mass(self) -> wp.array:
        """[n] m_i [kg]; a view, valid as long as the grid lives."""
        return self._view(self._precision.real, 3)

    @property
    def momentum(self) -> wp.array:
        """[n, 3] m_i v_i [kg m/s] after P2G, v_i [m/s] after the update; a view like `mass`."""
        return self._view(self._precision.vec3, 0)

    def _view(self, dtype, column: int) -> wp.array:
        values = self.values
        ptr = values.ptr + column * np.dtype(self._precision.numpy).itemsize
        return wp.array(
            ptr=ptr, dtype=dtype, shape=values.shape, strides=values.strides, device=values.device
        )

    @property
    def nbytes(self) -> int:
        """Bytes on the device."""
        arrays = (self.values, self.nodes, self.slots, self.marks, self.blocks, self.listed)
        return sum(a.capacity for a in arrays)

    @property
    def stored(self) -> list:
        """Arguments by which the kernels find the nodes of a step, in order."""
        return [self.nodes, self.slots, self.blocks, self.listed, self.shape, self.block_shape, self.threads]

    def clear(self) -> None:
        """Zero momentum and mass, and list no block."""
        if self.sparse:
            self.values.zero_()
            return
        inputs = [*self.stored, self.marks, self.values]
        wp.launch(self._clear, dim=self.threads, inputs=inputs, device=self.values.device)
        self.listed.zero_()


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

    `base` may be any integer: on a GPU a position far away gives the largest one, and adding to it overflows.
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
    """Storage index of a node; −1 if the node is not stored."""
    slot = flat
    if slots.shape[0] > 0:
        slot = slots[flat]
    return slot


@wp.func
def nodes_of_step(nodes: wp.array(dtype=wp.int32), listed: wp.array(dtype=wp.int32)):
    """Number of nodes that a step works on: the listed ones, or those in the reached blocks of a box."""
    if listed.shape[0] > 0:
        return listed[0] * wp.static(_BLOCK_NODES)
    return nodes.shape[0]


@wp.func
def node_of_step(
    index: int,
    nodes: wp.array(dtype=wp.int32),
    blocks: wp.array(dtype=wp.int32),
    shape: wp.vec3i,
    block_shape: wp.vec3i,
):
    """Flat index of the `index`-th node of a step; −1 where a block reaches over the edge of the box."""
    if nodes.shape[0] > 0:
        return nodes[index]
    block = node_of(blocks[index / wp.static(_BLOCK_NODES)], block_shape)
    within = node_of(index % wp.static(_BLOCK_NODES), wp.vec3i(BLOCK, BLOCK, BLOCK))
    i = BLOCK * block[0] + within[0]
    j = BLOCK * block[1] + within[1]
    k = BLOCK * block[2] + within[2]
    if i >= shape[0] or j >= shape[1] or k >= shape[2]:
        return -1
    return flat_index(i, j, k, shape)


@cache
def make_clear(precision: Precision):
    """Kernel that zeroes the nodes of the listed blocks and takes the blocks' marks away."""
    vec4 = precision.vec4

    @wp.kernel(enable_backward=False, module="unique")
    def clear(
        nodes: wp.array(dtype=wp.int32),
        slots: wp.array(dtype=wp.int32),
        blocks: wp.array(dtype=wp.int32),
        listed: wp.array(dtype=wp.int32),
        shape: wp.vec3i,
        block_shape: wp.vec3i,
        threads: int,
        marks: wp.array(dtype=wp.int32),
        values: wp.array(dtype=vec4),
    ):
        index = wp.tid()
        count = nodes_of_step(nodes, listed)
        while index < count:
            marks[blocks[index / wp.static(_BLOCK_NODES)]] = 0
            flat = node_of_step(index, nodes, blocks, shape, block_shape)
            if flat >= 0:
                values[storage(flat, slots)] = vec4()
            index += threads

    return clear


@cache
def make_reach(precision: Precision, shape_name: str):
    """Kernel that lists the blocks which hold a node of a particle's stencil, one thread a particle."""
    real, vec3 = precision.real, precision.vec3
    shape = shape_functions(precision, shape_name)
    base_node, width = shape.base_node, shape.degree + 1

    @wp.kernel(enable_backward=False, module="unique")
    def reach(
        x: wp.array(dtype=vec3),
        shape: wp.vec3i,
        block_shape: wp.vec3i,
        dx: real,
        marks: wp.array(dtype=wp.int32),
        blocks: wp.array(dtype=wp.int32),
        listed: wp.array(dtype=wp.int32),
    ):
        base = base_node(x[wp.tid()], real(1.0) / dx)
        if not inside(base, width, shape):
            return
        for i in range(base[0] / BLOCK, (base[0] + width - 1) / BLOCK + 1):
            for j in range(base[1] / BLOCK, (base[1] + width - 1) / BLOCK + 1):
                for k in range(base[2] / BLOCK, (base[2] + width - 1) / BLOCK + 1):
                    block = flat_index(i, j, k, block_shape)
                    # Read before the atomic, which costs more: nearly every particle finds its blocks marked.
                    if marks[block] == 0 and wp.atomic_cas(marks, block, 0, 1) == 0:
                        blocks[wp.atomic_add(listed, 0, 1)] = block

    return reach
