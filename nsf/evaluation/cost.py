"""Time and memory of the full-order and the reduced solver, both measured in one process."""

import gc
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass

import numpy as np

from nsf.timing import MemoryProbe, StageTimer, synchronizer

_WARM_UP = 2  # steps of a fresh solver that compile, load and capture everything


@dataclass(frozen=True)
class Subject:
    """What is timed.

    Attributes:
        build: gives a solver at t = 0 (`step`, `timed_step`, `nbytes`).
        steps: of a whole run.
    """

    build: Callable[[], object]
    steps: int


@dataclass(frozen=True)
class SolverCost:
    """Cost of one solver.

    Attributes:
        step_ms: median over the trials, each a whole run from t = 0, of the mean time of a step,
            nothing timed inside [ms]; step_ms_p10, step_ms_p90: quantiles.
        total_ms: median time of a whole run's steps [ms], set-up and warm-up left out.
        stages: median over steps spread through a run of each stage's time [ms], synchronised, so
            their sum exceeds a step.
        memory_mib: peak of every allocator during the first run, beyond what was held before it [MiB].
        allocators: the same by allocator [MiB].
        trials: number of runs.
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


def measure(subjects: dict[str, Subject], trials: int, device: str) -> dict[str, SolverCost]:
    """Whole runs of every solver, turn by turn, so that a machine that slows down slows all of them.

    Args:
        subjects: by name.
        trials: runs of each.
        device: `cpu`, `cuda` or `cuda:N`.
    """
    memory, times = {}, {name: [] for name in subjects}
    for trial in range(trials):
        for name, subject in subjects.items():
            if trial == 0:
                ms, *memory[name] = _first_trial(subject, device)
            else:
                ms = _step_ms(subject.build(), subject.steps, device)
            times[name].append(ms)
    found = {}
    for name, subject in subjects.items():
        p10, median, p90 = np.percentile(times[name], [10, 50, 90]).tolist()
        found[name] = SolverCost(
            step_ms=median,
            step_ms_p10=p10,
            step_ms_p90=p90,
            total_ms=median * subject.steps,
            stages=_stages(subject, trials, device),
            memory_mib=memory[name][0],
            allocators=memory[name][1],
            trials=trials,
        )
    return found


def _first_trial(subject: Subject, device: str) -> tuple[float, float, dict[str, float]]:
    """Time of a step, and peak memory beyond what was held before, whole and by allocator [MiB]."""
    gc.collect()  # what an earlier solver left behind; slow, so only where memory is measured
    with MemoryProbe(device) as before:
        pass
    solver = subject.build()
    gc.collect()
    with MemoryProbe(device, nbytes=lambda: solver.nbytes) as probe:
        ms = _step_ms(solver, subject.steps, device)
    return ms, probe.peak_mib - before.peak_mib, probe.allocators


def _step_ms(solver, steps: int, device: str) -> float:
    """Mean time of a step over a whole run [ms], those that warm up left out."""
    wait = synchronizer(device)
    warm = min(_WARM_UP, steps - 1)
    solver.step(warm)
    wait()
    started = time.perf_counter()
    solver.step(steps - warm)
    wait()
    return 1e3 * (time.perf_counter() - started) / (steps - warm)


def _stages(subject: Subject, samples: int, device: str) -> dict[str, float]:
    """Median time of each stage [ms] over uncaptured steps spread evenly through a run."""
    solver = subject.build()
    chosen = np.unique(np.linspace(min(_WARM_UP, subject.steps - 1), subject.steps - 1, samples).astype(int))
    found: dict[str, list[float]] = {}
    taken = 0
    for step in chosen.tolist():
        solver.step(step - taken)
        timer = StageTimer(device)
        solver.timed_step(timer)
        taken = step + 1
        for name, ms in timer.per_step(1).items():
            found.setdefault(name, []).append(ms)
    return {name: float(np.median(values)) for name, values in found.items()}
