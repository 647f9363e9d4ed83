"""The state of the particles, which a step changes."""

import numpy as np
import warp as wp

from nsf.mpm.grid.geometry import BLOCK
from nsf.mpm.precision import Precision


class ParticleArray:
    """A device array with rows in an order of their own, read and written in the particles' order.

    Args:
        rows: [P] array that kernels work on.
        order: [P] particle of each row.
    """

    def __init__(self, rows: wp.array, order: np.ndarray):
        self.rows, self._order = rows, order

    def numpy(self) -> np.ndarray:
        """Host copy."""
        rows = self.rows.numpy()
        values = np.empty_like(rows)
        values[self._order] = rows
        return values

    def assign(self, values: np.ndarray) -> None:
        """Take values from the host."""
        self.rows.assign(np.asarray(values)[self._order])


class ParticleState:
    """Device arrays that a step changes.

    Args:
        x, v: [P, 3] position [m] and velocity [m/s].
        history: [P, H] history variables.
        order: [P] particle of each row (`cell_order`).
        precision: floating-point types.
        device: Warp device.

    Attributes:
        x, v: [P, 3] position [m] and velocity [m/s].
        C: [P, 3, 3] affine momentum [1/s].
        F_e: [P, 3, 3] elastic deformation gradient.
        tau: [P, 3, 3] Kirchhoff stress [Pa].
        history: [P] vectors of the law's history variables.
        order: [P] particle of each row, on the device.
    """

    def __init__(
        self,
        x: np.ndarray,
        v: np.ndarray,
        history: np.ndarray,
        order: np.ndarray,
        precision: Precision,
        device,
    ):
        real, vec3, mat33 = precision.real, precision.vec3, precision.mat33
        vecH = wp.types.vector(length=history.shape[1], dtype=real)

        def array_of(values: np.ndarray, dtype) -> ParticleArray:
            return ParticleArray(wp.array(values[order], dtype=dtype, device=device), order)

        def filled(value) -> ParticleArray:
            return ParticleArray(wp.full(len(x), value, dtype=mat33, device=device), order)

        self.x, self.v, self.history = array_of(x, vec3), array_of(v, vec3), array_of(history, vecH)
        # Made on the device: for millions of particles these are gigabytes of one value.
        self.C, self.tau, self.F_e = filled(mat33()), filled(mat33()), filled(mat33(np.eye(3)))
        self.order = wp.array(order, dtype=wp.int32, device=device)

    def __len__(self) -> int:
        return self.order.shape[0]

    def unload(self) -> None:
        """Let no particle be deformed, stressed or turning: F_e = 1, τ = 0, C = 0."""
        for array in (self.C, self.tau):
            array.rows.zero_()
        self.F_e.rows.fill_(self.F_e.rows.dtype(np.eye(3)))

    @property
    def nbytes(self) -> int:
        """Bytes on the device."""
        changing = (self.x, self.v, self.C, self.F_e, self.tau, self.history)
        return sum(a.rows.capacity for a in changing) + self.order.capacity

    def numpy(self) -> dict[str, np.ndarray]:
        """Host copies: x, v [P, 3], C, F_e, tau [P, 3, 3], history [P, H]."""
        return {name: getattr(self, name).numpy() for name in ("x", "v", "C", "F_e", "tau", "history")}


def cell_order(x: np.ndarray, dx: float, offset: float) -> np.ndarray:
    """[P] particles by block of 4³ cells, and within a block by cell.

    Neighbours in memory then reach the same nodes. Particles that flow leave this order, which only costs
    time.

    Args:
        x: [P, 3] positions [m], which may be off the grid or not finite.
        dx: grid spacing [m].
        offset: distance from a particle down to the lowest node of its stencil [dx].
    """
    with np.errstate(invalid="ignore"):
        cells = np.clip(np.nan_to_num(x / dx - offset), 0, 2**20 - 1).astype(np.int64)
    block, within = cells // BLOCK, cells % BLOCK
    i, j, k = block.T << np.array([[36], [18], [0]])
    a, b, c = within.T
    return np.argsort(((i | j | k) * BLOCK**3) + (a * BLOCK + b) * BLOCK + c, kind="stable")
