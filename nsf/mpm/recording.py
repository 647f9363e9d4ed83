"""Frames of a run, packed on the device and copied to the host in blocks."""

import contextlib
import queue
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache, partial

import numpy as np
import warp as wp

from nsf.gpu import without_collection
from nsf.mpm.precision import FP32, Precision
from nsf.mpm.state import ParticleState

#: Components of a recorded field: C by rows, tau as xx, xy, xz, yy, yz, zz.
COMPONENTS = {"x": 3, "v": 3, "C": 9, "tau": 6}
_BLOCK_BYTES = 2**26

_Memory = dict[str, wp.array]


class HostMemory:
    """Host memory for blocks of frames. A block gives its memory back when it is done.

    Memory is used again, because filling fresh pages is slower than writing a block to disk. Blocks of
    several recorders may share the memory, and other threads may finish them. For a GPU the memory is pinned.
    """

    def __init__(self):
        self._free: queue.SimpleQueue[_Memory] = queue.SimpleQueue()

    def take(self, like: _Memory) -> _Memory:
        """Arrays of the same shapes and types as the given ones."""
        with contextlib.suppress(queue.Empty):
            memory = self._free.get_nowait()
            if _kinds(memory) == _kinds(like):
                return memory
        pinned = any(a.device.is_cuda for a in like.values())
        return {name: wp.empty(a.shape, a.dtype, device="cpu", pinned=pinned) for name, a in like.items()}

    def give_back(self, memory: _Memory) -> None:
        """Let another block have the arrays."""
        self._free.put(memory)


def _kinds(memory: _Memory) -> list[tuple]:
    return [(array.shape, array.dtype) for array in memory.values()]


@dataclass(frozen=True)
class Block:
    """Frames on the host.

    Attributes:
        fields: x, v [n, P, 3], C [n, P, 9] and τ [n, P, 6].
        done: call it once the frames are no longer needed; they are lost then.
    """

    fields: dict[str, np.ndarray]
    done: Callable[[], None]

    def __iter__(self) -> Iterator[dict[str, np.ndarray]]:
        """The fields of each frame."""
        for frame in zip(*self.fields.values(), strict=True):
            yield dict(zip(self.fields, frame, strict=True))


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
        count: wp.array(dtype=wp.int32),
        frames_x: wp.array3d(dtype=out),
        frames_v: wp.array3d(dtype=out),
        frames_C: wp.array3d(dtype=out),
        frames_tau: wp.array3d(dtype=out),
    ):
        row = wp.tid()
        n, p = count[0], order[row]
        for a in range(3):
            frames_x[n, p, a] = out(x[row][a])
            frames_v[n, p, a] = out(v[row][a])
            for b in range(3):
                frames_C[n, p, 3 * a + b] = out(C[row][a, b])
        t = tau[row]
        frames_tau[n, p, 0] = out(t[0, 0])
        frames_tau[n, p, 1] = out(t[0, 1])
        frames_tau[n, p, 2] = out(t[0, 2])
        frames_tau[n, p, 3] = out(t[1, 1])
        frames_tau[n, p, 4] = out(t[1, 2])
        frames_tau[n, p, 5] = out(t[2, 2])

    return pack


@wp.kernel(enable_backward=False)
def _count_on(count: wp.array(dtype=wp.int32)):
    count[0] = count[0] + 1


def block_bytes(particles: int, stored: Precision) -> int:
    """[byte] of a block: as many frames as 64 MiB hold, at least one."""
    frame = frame_bytes(particles, stored)
    return frame * max(1, _BLOCK_BYTES // frame)


def frame_bytes(particles: int, stored: Precision) -> int:
    """[byte] of a frame, on disk as in memory."""
    return particles * sum(COMPONENTS.values()) * np.dtype(stored.numpy).itemsize


class FrameRecorder:
    """Collects frames of a state on its device; on a GPU by a graph, as a launch from Python outlasts a step.

    Args:
        state: the state to record.
        precision: of the state.
        stored: precision of the recorded values.
        memory: host memory of the blocks.
        capacity: most frames of a block.
        room: [byte] of a block, at most; it holds one frame at least.
    """

    def __init__(
        self,
        state: ParticleState,
        precision: Precision,
        stored: Precision = FP32,
        memory: HostMemory | None = None,
        capacity: int | None = None,
        room: int = _BLOCK_BYTES,
    ):
        self._memory = memory or HostMemory()
        self._state = state
        self._device = state.order.device
        fitting = max(1, room // frame_bytes(len(state), stored))
        self.capacity = min(capacity or fitting, fitting)
        # A field lies in one piece, as on disk, so that its frames are written without another copy.
        self._block = {
            name: wp.empty((self.capacity, len(state), c), dtype=stored.real, device=self._device)
            for name, c in COMPONENTS.items()
        }
        self._pack = _make_pack(precision, stored)
        self._place = wp.zeros(1, dtype=wp.int32, device=self._device)  # of the next frame, for the kernel
        self._graph = None
        self.count = 0

    @property
    def full(self) -> bool:
        """Whether `take` must be called before the next frame."""
        return self.count == self.capacity

    def record(self) -> None:
        """Pack the current state as the next frame."""
        if self._graph is not None:
            wp.capture_launch(self._graph)
        else:
            self._launch()  # uncaptured, so that both kernels are compiled and loaded
            if self._device.is_cuda:
                with without_collection(), wp.ScopedCapture(device=self._device) as capture:
                    self._launch()
                self._graph = capture.graph
        self.count += 1

    def _launch(self) -> None:
        s = self._state
        inputs = [s.x.rows, s.v.rows, s.C.rows, s.tau.rows, s.order, self._place, *self._block.values()]
        wp.launch(self._pack, dim=len(s), inputs=inputs, device=self._device)
        wp.launch(_count_on, dim=1, inputs=[self._place], device=self._device)

    def on_device(self) -> dict[str, wp.array]:
        """The frames recorded since the last call, where they are; the next one writes over them."""
        wp.synchronize_device(self._device)
        count = self._begin()
        return {name: block[:count] for name, block in self._block.items()}

    def take(self) -> Block:
        """Host copy of the frames recorded since the last call."""
        memory, count = self._memory.take(self._block), self.count
        for name, block in self._block.items():
            wp.copy(memory[name], block, count=count * block[0].size)
        wp.synchronize_device(self._device)
        self._begin()
        fields = {name: values.numpy()[:count] for name, values in memory.items()}
        return Block(fields, partial(self._memory.give_back, memory))

    def _begin(self) -> int:
        """Begin at the first frame again; how many there were."""
        count, self.count = self.count, 0
        self._place.zero_()
        return count


def blocks(
    solver,
    steps: int,
    stored: Precision,
    after=lambda: None,
    memory: HostMemory | None = None,
    every: int = 1,
) -> Iterator[Block]:
    """The present state and the state after each `every`-th of `steps` steps, in blocks of frames.

    Args:
        solver: a `FullOrderMPM`.
        steps: number of steps to take.
        stored: precision of the frames.
        after: called after each frame.
        memory: host memory of the blocks, which other runs may share; their own by default.
        every: steps from a frame to the next; divides `steps`.

    Raises:
        InstabilityError: the solver loses stability. The error comes after the last block if the last check
            finds it.
    """
    recorder = FrameRecorder(solver.state, solver.precision, stored, memory)
    for n in range(0, steps + 1, every):
        if n:
            solver.step(every)
        recorder.record()
        after()
        if recorder.full or n == steps:
            yield recorder.take()
    solver.check()
