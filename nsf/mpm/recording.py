"""Frames of a run, packed on the device and copied to the host in blocks."""

from collections.abc import Iterator
from functools import cache

import numpy as np
import warp as wp

from nsf.mpm.precision import FP32, Precision
from nsf.mpm.state import ParticleState

#: Columns of a packed frame: x (3), v (3), C (9, row major), tau (6: xx, xy, xz, yy, yz, zz).
COLUMNS = {"x": slice(0, 3), "v": slice(3, 6), "C": slice(6, 15), "tau": slice(15, 21)}
_WIDTH = 21
_BLOCK_BYTES = 2**28


@cache
def _make_pack(precision: Precision, stored: Precision):
    vec3, mat33, out = precision.vec3, precision.mat33, stored.real

    @wp.kernel(enable_backward=False, module="unique")
    def pack(
        x: wp.array(dtype=vec3),
        v: wp.array(dtype=vec3),
        C: wp.array(dtype=mat33),
        tau: wp.array(dtype=mat33),
        order: wp.array(dtype=wp.int32),
        frame: wp.array2d(dtype=out),
    ):
        row = wp.tid()
        p = order[row]
        for a in range(3):
            frame[p, a] = out(x[row][a])
            frame[p, 3 + a] = out(v[row][a])
            for b in range(3):
                frame[p, 6 + 3 * a + b] = out(C[row][a, b])
        t = tau[row]
        frame[p, 15] = out(t[0, 0])
        frame[p, 16] = out(t[0, 1])
        frame[p, 17] = out(t[0, 2])
        frame[p, 18] = out(t[1, 1])
        frame[p, 19] = out(t[1, 2])
        frame[p, 20] = out(t[2, 2])

    return pack


class FrameRecorder:
    """Collects frames of a state on its device.

    Args:
        state: what is recorded.
        precision: of the state.
        stored: precision of the recorded values.
    """

    def __init__(self, state: ParticleState, precision: Precision, stored: Precision = FP32):
        self._state = state
        self._device = state.order.device
        frame_bytes = len(state) * _WIDTH * np.dtype(stored.numpy).itemsize
        self.capacity = max(1, _BLOCK_BYTES // frame_bytes)
        shape = (self.capacity, len(state), _WIDTH)
        self._block = wp.empty(shape, dtype=stored.real, device=self._device)
        self._pack = _make_pack(precision, stored)
        self.count = 0

    @property
    def full(self) -> bool:
        """Whether the block must be taken before the next frame."""
        return self.count == self.capacity

    def record(self) -> None:
        """Pack the current state as the next frame."""
        s = self._state
        inputs = [s.x.rows, s.v.rows, s.C.rows, s.tau.rows, s.order, self._block[self.count]]
        wp.launch(self._pack, dim=len(s), inputs=inputs, device=self._device)
        self.count += 1

    def take(self) -> np.ndarray:
        """Host copy of the frames [n, P, 21] recorded since the last call."""
        block = self._block[: self.count].numpy().copy()
        self.count = 0
        return block


def blocks(solver, steps: int, stored: Precision, after=lambda: None) -> Iterator[np.ndarray]:
    """The state as it stands and after each of `steps` steps, in blocks of packed frames [n, P, 21].

    Args:
        solver: a `FullOrderMPM`.
        steps: to be taken.
        stored: precision of the frames.
        after: called after each frame.

    Raises:
        InstabilityError: the solver loses stability; after the last block, if its last check finds it.
    """
    recorder = FrameRecorder(solver.state, solver.precision, stored)
    for n in range(steps + 1):
        if n:
            solver.step()
        recorder.record()
        after()
        if recorder.full or n == steps:
            yield recorder.take()
    solver.check()


def unpacked(frame: np.ndarray) -> tuple[np.ndarray, ...]:
    """x, v [P, 3], C [P, 9] and τ [P, 6] of a packed frame [P, 21]."""
    return tuple(frame[:, columns] for columns in COLUMNS.values())
