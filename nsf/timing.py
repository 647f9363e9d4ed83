"""Time and memory of a region, on any device.

No array library is imported here, so that layers which must not import one
can be timed: a device is reached through the library that is already loaded.
"""

import itertools
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from types import ModuleType
from typing import Any

from nsf.errors import DeviceError

Synchronize = Callable[[], object]
_MIB = 2**20


def synchronizer(device: Any = "cpu") -> Synchronize:
    """A call that waits until `device` has done everything asked of it.

    On CUDA the call waits for the whole device, whichever library's stream the
    work is on. On the CPU it returns at once.

    Raises:
        DeviceError: `device` is a GPU and neither torch nor Warp is loaded.
    """
    if not _is_cuda(device):
        return lambda: None
    if torch := _loaded("torch", lambda torch: torch.cuda.is_available()):
        return lambda: torch.cuda.synchronize(str(device))
    if warp := _loaded("warp", lambda warp: warp.is_cuda_available()):
        return lambda: warp.synchronize_device(str(device))
    raise DeviceError(
        f"device={device} cannot be timed: no loaded library reaches a GPU; use device=cpu, "
        "or import torch or warp first"
    )


def elapsed_ms(call: Callable[[], object], wait: Synchronize) -> float:
    """Time of a call [ms], around a device that `wait` synchronises."""
    wait()
    begun = time.perf_counter()
    call()
    wait()
    return 1e3 * (time.perf_counter() - begun)


def untimed(stage: str) -> AbstractContextManager[None]:
    """A stand-in for a `StageTimer` that times nothing."""
    return nullcontext()


class StageTimer:
    """Wall time of named stages.

        timer = StageTimer(device)
        with timer("p2g"):
            ...
        timer.per_step(200)   # {"p2g": milliseconds}

    A call reads the host's clock before and after its block, each time with the
    device synchronised. Synchronised stages cannot overlap, so their sum exceeds
    an untimed step, and on a GPU it includes the wait for launches. Publish the
    time of the whole step beside such a breakdown. In a CUDA graph, use
    `captured` in place of a call: events in the graph then time its stages.

        with capture() as graph:
            with timer.captured("p2g"):
                ...
        launch(graph)
        timer.add_launch()

    Args:
        device: "cpu", "cuda:0" or a library's device object.
        synchronize: waits for the device; `synchronizer(device)` by default.
    """

    def __init__(self, device: Any = "cpu", synchronize: Synchronize | None = None) -> None:
        self.milliseconds: dict[str, float] = {}
        self._device = device
        self._synchronize = synchronize or synchronizer(device)
        self._marks: list[tuple[str, Any]] = []

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        """Add the block's time [ms] to `stage`; a block that raises is not counted."""
        self._synchronize()
        start = time.perf_counter()
        yield
        self._synchronize()
        self._add(stage, 1e3 * (time.perf_counter() - start))

    @contextmanager
    def captured(self, stage: str) -> Iterator[None]:
        """Mark the end of `stage` in the graph that is being captured on Warp's stream of the device.

        A stage begins where the one before it ended. Work of the block on other streams counts only as
        far as the device's stream waits for it.

        Raises:
            DeviceError: torch or Warp is not loaded.
        """
        if not self._marks:
            self._marks.append(("", self._mark()))
        try:
            yield
        except BaseException:
            self._marks.clear()  # of a graph that will never be launched
            raise
        self._marks.append((stage, self._mark()))

    def add_launch(self) -> None:
        """Add the times [ms] of the stages of a captured graph, once it has been launched."""
        self._synchronize()
        for (_, start), (stage, end) in itertools.pairwise(self._marks):
            self._add(stage, start.elapsed_time(end))
        self._marks.clear()

    def per_step(self, steps: int) -> dict[str, float]:
        """Mean time [ms] a step of every stage, in the order they first ran."""
        return {stage: total / steps for stage, total in self.milliseconds.items()}

    def _add(self, stage: str, ms: float) -> None:
        self.milliseconds[stage] = self.milliseconds.get(stage, 0.0) + ms

    def _mark(self) -> Any:
        torch = _loaded("torch", lambda torch: torch.cuda.is_available())
        warp = _loaded("warp", lambda warp: warp.is_cuda_available())
        if not (torch and warp):
            raise DeviceError("stages within a CUDA graph are timed by torch on Warp's stream; import both")
        held = warp.get_device(str(self._device)).stream.cuda_stream
        stream = torch.cuda.ExternalStream(held, device=str(self._device))
        event = torch.cuda.Event(enable_timing=True, external=True)
        with torch.cuda.stream(stream):  # torch asks its own current stream whether it is being captured
            event.record(stream)
        return event


class MemoryProbe:
    """Peak device memory over a region, over all allocators.

        with MemoryProbe(device, nbytes=lambda: solver.nbytes) as probe:
            ...
        probe.peak_mib, probe.grown_mib

    On CUDA the peak is the sum of the peaks of torch's allocator and Warp's memory
    pool. This is an upper bound, because the two may not coincide. Warp cannot
    reset its high-water mark: a region that stays below an earlier one counts the
    memory that Warp holds at its start or end. On the CPU no allocator can be
    asked; the probe reads the caller's `nbytes` at the end.

    Args:
        device: "cpu", "cuda:0" or a library's device object.
        nbytes: [byte] held by the solvers, or a function of it; only used on the CPU.

    Attributes:
        peak_mib: [MiB] most memory held at a time.
        grown_mib: [MiB] `peak_mib` less the memory held on entry.
    """

    def __init__(self, device: Any = "cpu", nbytes: int | Callable[[], int] = 0) -> None:
        self.device = device
        self.peak_mib = self.grown_mib = 0.0
        self._nbytes = nbytes
        self._torch = self._warp = None
        if _is_cuda(device):
            synchronizer(device)  # raises where the device cannot be reached
            self._torch = _loaded("torch", lambda torch: torch.cuda.is_available())
            self._warp = _loaded(
                "warp", lambda warp: warp.is_cuda_available() and warp.is_mempool_enabled(str(device))
            )

    def __enter__(self) -> "MemoryProbe":
        if self._torch:
            self._torch.cuda.init()  # before its allocator is asked: where nothing has been on the GPU yet
            self._torch.cuda.reset_peak_memory_stats(str(self.device))
        if self._warp:
            self._mark = self._warp.get_mempool_used_mem_high(str(self.device))
        self._held = self._current()
        return self

    def __exit__(self, *exception: object) -> None:
        if not _is_cuda(self.device):
            nbytes = self._nbytes() if callable(self._nbytes) else self._nbytes
            self.peak_mib = self.grown_mib = nbytes / _MIB
            return
        peak = self._current()
        if self._torch:
            peak["torch"] = self._torch.cuda.max_memory_allocated(str(self.device))
        if self._warp:
            mark = self._warp.get_mempool_used_mem_high(str(self.device))
            peak["warp"] = mark if mark > self._mark else max(peak["warp"], self._held["warp"])
        self.peak_mib = sum(peak.values()) / _MIB
        self.grown_mib = self.peak_mib - sum(self._held.values()) / _MIB

    def _current(self) -> dict[str, int]:
        held = {}
        if self._torch:
            held["torch"] = self._torch.cuda.memory_allocated(str(self.device))
        if self._warp:
            held["warp"] = self._warp.get_mempool_used_mem_current(str(self.device))
        return held


def _is_cuda(device: Any) -> bool:
    return str(device).startswith("cuda")


def _loaded(name: str, usable: Callable[[ModuleType], bool]) -> Any:
    module = sys.modules.get(name)
    return module if module is not None and usable(module) else None
