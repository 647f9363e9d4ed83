"""P2G, grid update and G2P: the part of a step that the full-order and the reduced solver share."""

import warp as wp

from nsf.errors import ConfigError
from nsf.mpm.forcing import Forcing
from nsf.mpm.grid.nodes import Grid, make_reach
from nsf.mpm.native.access import WARP
from nsf.mpm.stability import check_colliders
from nsf.mpm.transfer import Transfer, make_g2p, make_p2g
from nsf.mpm.transfer.scatter import THREADS, particles_of_warp
from nsf.mpm.update import make_grid_update, make_update_g2p


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
