"""Integration particles N: those that one MPM step of the sample particles needs (paper section 5.4)."""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache

import numpy as np
import torch
import warp as wp

from nsf.dynamics.interop import as_vectors, on_torch_stream
from nsf.errors import ConfigError
from nsf.mpm import GridGeometry, Precision
from nsf.mpm.grid.nodes import flat_index, inside
from nsf.mpm.grid.shape import shape_functions, stencil_offset

#: Nodes by which the integration particles are widened at most; every grid of the scenes is smaller.
_WIDEST = 512
STRATEGIES = ("superset", "search")


@dataclass(frozen=True)
class Integration:
    """How a step determines its integration particles N.

    Attributes:
        strategy: `search` finds N anew at each step, as the paper does (a, b); `superset` fixes it before the
            run as the union over the training trajectories. With `field=basis` that union holds the
            candidates, among which N is found at each step; with `search` every particle is one.
        margin: nodes by which the superset's node set is widened, so that values between
            the training values stay inside.

    Raises:
        ConfigError: unknown strategy, or a margin outside 0 to `_WIDEST` nodes.
    """

    strategy: str = "superset"
    margin: int = 1

    def __post_init__(self):
        if self.strategy not in STRATEGIES:
            raise ConfigError(
                f"integration.strategy={self.strategy!r} is unknown; choose one of {', '.join(STRATEGIES)}"
            )
        if not 0 <= self.margin <= _WIDEST:
            raise ConfigError(f"integration.margin={self.margin} must be from 0 to {_WIDEST} nodes")


@dataclass(frozen=True)
class ParticleSets:
    """The sets of one span of time.

    Attributes:
        sample: [s] indices of S.
        integration: [n] indices of N, or of its candidates; its first s entries are S.
        nodes: [k] flat indices of the grid nodes I, ascending.
    """

    sample: np.ndarray
    integration: np.ndarray
    nodes: np.ndarray


@cache
def _kernels(precision: Precision, shape_name: str):
    real, vec3 = precision.real, precision.vec3
    shape = shape_functions(precision, shape_name)
    base_node, width = shape.base_node, shape.degree + 1

    @wp.kernel(enable_backward=False, module="unique")
    def mark_nodes(
        x: wp.array(dtype=vec3), dx: real, margin: int, grid_shape: wp.vec3i, marked: wp.array(dtype=wp.uint8)
    ):
        p = wp.tid()
        base = base_node(x[p], real(1.0) / dx)
        if not inside(base, width, grid_shape):
            return
        for a in range(-margin, width + margin):
            for b in range(-margin, width + margin):
                for c in range(-margin, width + margin):
                    node = wp.vec3i(base[0] + a, base[1] + b, base[2] + c)
                    if inside(node, 1, grid_shape):
                        marked[flat_index(node[0], node[1], node[2], grid_shape)] = wp.uint8(1)

    @wp.kernel(enable_backward=False, module="unique")
    def flag_particles(
        x: wp.array(dtype=vec3),
        dx: real,
        grid_shape: wp.vec3i,
        marked: wp.array(dtype=wp.uint8),
        touching: wp.array(dtype=wp.uint8),
    ):
        p = wp.tid()
        base = base_node(x[p], real(1.0) / dx)
        if not inside(base, width, grid_shape):
            return
        for a in range(width):
            for b in range(width):
                for c in range(width):
                    if marked[flat_index(base[0] + a, base[1] + b, base[2] + c, grid_shape)] != wp.uint8(0):
                        touching[p] = wp.uint8(1)

    return mark_nodes, flag_particles


class NeighbourSearch:
    """Finds I and N for given positions of all particles.

    Args:
        geometry: the grid.
        shape: B-spline name.
        precision: of the positions.
        device: Warp device.

    Source: paper section 5.4, a and b.
    """

    def __init__(self, geometry: GridGeometry, shape: str, precision: Precision, device):
        self.geometry, self.precision, self.device = geometry, precision, device
        self._reach = stencil_offset(shape) * geometry.dx  # of a stencil, downwards
        self._mark, self._flag = _kernels(precision, shape)

    def mark_nodes(self, x: torch.Tensor, marked: torch.Tensor, margin: int = 0) -> None:
        """Set `marked` [all nodes] where a particle at x [n, 3] has weight, and `margin` nodes around."""
        g = self.geometry
        inputs = [
            as_vectors(x, self.precision),
            self.precision.real(g.dx),
            margin,
            wp.vec3i(*g.nodes),
            wp.from_torch(marked),
        ]
        with on_torch_stream(self.device):
            wp.launch(self._mark, dim=len(x), inputs=inputs, device=self.device)

    def flag_particles(self, x: torch.Tensor, marked: torch.Tensor, touching: torch.Tensor) -> None:
        """Set `touching` [P] where a particle at x [P, 3] touches a marked node."""
        g = self.geometry
        inputs = [as_vectors(x, self.precision), self.precision.real(g.dx), wp.vec3i(*g.nodes)]
        inputs += [wp.from_torch(marked), wp.from_torch(touching)]
        with on_torch_stream(self.device):
            wp.launch(self._flag, dim=len(x), inputs=inputs, device=self.device)

    def no_nodes(self, device: torch.device) -> torch.Tensor:
        """An empty node mark [all nodes]."""
        return torch.zeros(self.geometry.count, dtype=torch.uint8, device=device)

    def integration_mask(self, x: torch.Tensor, sample: torch.Tensor) -> torch.Tensor:
        """[P] mask of N, the particles that share a node with `sample` [s], with all at x [P, 3]."""
        marked = self.no_nodes(x.device)
        self.mark_nodes(x[sample].contiguous(), marked)
        touching = torch.zeros(len(x), dtype=torch.uint8, device=x.device)
        self.flag_particles(x.contiguous(), marked, touching)
        return touching.bool()

    def on_grid(self, x: torch.Tensor) -> torch.Tensor:
        """[...] whether stencils of particles at x [..., 3] lie on the grid; False where x is not finite."""
        upper = torch.tensor(self.geometry.upper, dtype=x.dtype, device=x.device) - self._reach
        return ((x >= self._reach) & (x < upper)).all(-1)

    def missing(self, x: torch.Tensor, sets: ParticleSets) -> int:
        """How many particles and nodes S needs and sets lack, or are off the grid, with all at x [P, 3]."""
        sample, integration, nodes = (
            torch.as_tensor(of, device=x.device).long() for of in (sets.sample, sets.integration, sets.nodes)
        )
        outside = self.integration_mask(x, sample)
        outside[integration] = False
        marked = self.no_nodes(x.device)
        self.mark_nodes(x[sample].contiguous(), marked)
        marked[nodes] = 0
        return int(outside.sum()) + int(marked.sum()) + int((~self.on_grid(x)).sum())

    def superset(self, frames: Iterable[torch.Tensor], sample: np.ndarray, margin: int) -> ParticleSets:
        """Union of I and of N over many configurations.

        Args:
            frames: positions [F, P, 3] of all particles, chunk by chunk.
            sample: [s] indices of S.
            margin: nodes by which I is widened.
        """
        mask = nodes = None
        for chunk in frames:
            if mask is None:
                chosen = torch.as_tensor(sample, device=chunk.device)
                nodes = self.no_nodes(chunk.device)
                mask = torch.zeros(chunk.shape[1], dtype=torch.uint8, device=chunk.device)
            for x in chunk:
                # A configuration's own nodes: N is their union, not the neighbours of the union.
                marked = self.no_nodes(x.device)
                self.mark_nodes(x[chosen].contiguous(), marked, margin)
                self.flag_particles(x.contiguous(), marked, mask)
                nodes |= marked
        return particle_sets(sample, mask.bool(), nodes)


def particle_sets(sample: np.ndarray, mask: torch.Tensor, nodes: torch.Tensor) -> ParticleSets:
    """Particle sets from masks, S first in N.

    Args:
        sample: [s] indices of S.
        mask: [P] mask of N.
        nodes: [all nodes] mark of I.
    """
    mask = mask.clone()
    mask[torch.as_tensor(sample, device=mask.device)] = False
    neighbours = torch.nonzero(mask).flatten().cpu().numpy()
    flat = torch.nonzero(nodes).flatten().to(torch.int32).cpu().numpy()
    return ParticleSets(sample, np.concatenate([sample, neighbours]), flat)
