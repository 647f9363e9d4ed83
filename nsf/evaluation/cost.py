"""Time and memory of the full-order and the reduced solver, both measured in one process."""

import gc
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass

import numpy as np

from nsf.timing import MemoryProbe, StageTimer, synchronizer


@dataclass(frozen=True)
class SolverCost:
    """Cost of one solver.

    Attributes:
        step_ms: median over the parts of a run of a step's time, untimed inside [ms]; p10, p90: quantiles.
        total_ms: time of a whole run at the mean of its parts [ms].
        stages: median over some steps of each stage's time [ms], synchronised, so their sum exceeds a step.
        memory_mib: peak of every allocator during the run, beyond what was held before the solver [MiB].
        allocators: the same by allocator [MiB].
        trials: how many parts were timed.
    """

    step_ms: float
    step_ms_p10: float
    step_ms_p90: float
    total_ms: float
    stages: dict[str, float]
    memory_mib: float
    allocators: dict[str, float]
    trials: int

    def as_dict(self) -> dict:
        """Plain containers."""
        return asdict(self)


def measure(build: Callable[[], object], steps: int, repeats: int, device: str) -> SolverCost:
    """Time a run in `repeats` equal parts, then its stages, then its memory.

    Args:
        build: gives a solver at t = 0 (`step`, `stages`, `nbytes`).
        steps: of a whole run.
        repeats: parts.
        device: `cpu` or `cuda`.
    """
    held = _held(device)
    solver = build()
    gc.collect()
    wait = synchronizer(device)
    warm = min(2, steps - 1)  # these compile, load and capture everything
    part = max(1, (steps - warm) // repeats)
    times = []
    with MemoryProbe(device, nbytes=lambda: solver.nbytes) as probe:
        solver.step(warm)
        for _ in range(min(repeats, (steps - warm) // part)):
            wait()
            started = time.perf_counter()
            solver.step(part)
            wait()
            times.append(1e3 * (time.perf_counter() - started) / part)
    solver = build()
    solver.step(1)
    stages = _breakdown(solver, min(repeats, steps - 1), device)
    p10, median, p90 = np.percentile(times, [10, 50, 90]).tolist()
    return SolverCost(
        step_ms=median,
        step_ms_p10=p10,
        step_ms_p90=p90,
        total_ms=float(np.mean(times)) * steps,
        stages=stages,
        memory_mib=probe.peak_mib - held,
        allocators=probe.allocators,
        trials=len(times),
    )


def _held(device: str) -> float:
    gc.collect()
    with MemoryProbe(device) as probe:
        pass
    return probe.peak_mib


def _breakdown(solver, repeats: int, device: str) -> dict[str, float]:
    """Median time of each stage [ms] over some uncaptured steps."""
    samples: dict[str, list[float]] = {}
    for _ in range(repeats):
        timer = StageTimer(device)
        solver.timed_step(timer)
        for name, ms in timer.per_step(1).items():
            samples.setdefault(name, []).append(ms)
    return {name: float(np.median(values)) for name, values in samples.items()}
