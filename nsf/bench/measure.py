"""Times of calls: turn by turn, after a warm-up, around a synchronised device."""

import gc
import itertools
import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import warp as wp

from nsf.gpu import without_collection
from nsf.timing import MemoryProbe, elapsed_ms, synchronizer

WINDOW = 100  # steps of a trial at most, so that the clock and the last synchronisation are lost in it
WARM_UP = 3  # steps that compile, load and capture
_COPY_BYTES = {"cuda": 2**30, "cpu": 2**27}  # larger than any cache
_TRIALS = 5  # of passes
_REPEATS = 10  # of a pass in one graph, so that launching it costs nothing


def build(make: Callable[[], object], device: str) -> tuple[object, float]:
    """A solver that has taken its first steps, and its peak memory [MiB] beyond what was held before."""
    solver = None

    def begin() -> None:
        nonlocal solver
        solver = make()
        solver.step(WARM_UP)

    peak = peak_mib(begin, device, lambda: 0 if solver is None else solver.nbytes)
    return solver, peak


def peak_mib(call: Callable[[], object], device: str, nbytes: int | Callable[[], int] = 0) -> float:
    """Most memory [MiB] that a call holds beyond what was held before it.

    Args:
        call: made once.
        device: `cpu` or `cuda:N`.
        nbytes: what it left behind [byte]; stands for the peak where the device's allocators do not tell.
    """
    gc.collect()
    with MemoryProbe(device, nbytes=nbytes) as probe:
        call()
    return probe.grown_mib


def window_times(
    solvers: Mapping[str, object], total: int, trials: int, device: str
) -> dict[str, np.ndarray]:
    """[trials] mean time of a step [ms] in windows spread over a run, the same of every solver, in turns.

    Args:
        solvers: by name; each has taken its warm-up steps (`build`) and no others.
        total: steps of the run, more than the warm-up's.
        trials: windows; fewer where there are not so many steps.
        device: of all.
    """
    wait, taken = synchronizer(device), {name: [] for name in solvers}
    edges = np.unique(np.linspace(WARM_UP, total, trials + 1).round().astype(int)).tolist()
    for start, end in itertools.pairwise(edges):
        steps = min(end - start, WINDOW)
        for name, solver in solvers.items():
            solver.step(start - solver.steps_taken)
            taken[name].append(elapsed_ms(partial(solver.step, steps), wait) / steps)
    return {name: np.array(times) for name, times in taken.items()}


@dataclass
class WholeRun:
    """A run of a solver from t = 0 to its end.

    Attributes:
        solver: with `restart` and `step`.
        steps: of the run.
    """

    solver: Any
    steps: int

    def restart(self) -> None:
        """Go back to t = 0."""
        self.solver.restart()

    def run(self) -> None:
        """Take every step."""
        self.solver.step(self.steps)


def taught(chain) -> None:
    """Make, or reuse, all that runs by the recurrence of a `nsf.pipeline.Pipeline` need, and their bounds."""
    chain.simulate(("train",))
    chain.train()
    chain.teach()
    for other in chain.calibrating:
        other.deploy()


def turns(
    sides: Mapping[Any, WholeRun], trials: int, device: str, limit: float = math.inf
) -> dict[Any, np.ndarray]:
    """[trials] time of whole runs [ms] of each side, turn by turn.

    The first run of each, which compiles, loads and captures, is left out.

    Args:
        sides: by name.
        trials: of each.
        device: of all.
        limit: [s] after which no further turn begins.
    """
    wait, taken, begun = synchronizer(device), {name: [] for name in sides}, time.perf_counter()
    for trial in range(trials + 1):
        for name, side in sides.items():
            side.restart()
            ms = elapsed_ms(side.run, wait)
            if trial:
                taken[name].append(ms)
        if trial and time.perf_counter() - begun > limit:
            break
    return {name: np.array(times) for name, times in taken.items()}


def pass_time(call: Callable[[], None], device: str) -> float:
    """Median time of one call of kernels [ms]; on a GPU from a graph of many."""
    wait = synchronizer(device)

    def many() -> None:
        for _ in range(_REPEATS):
            call()

    call()
    if wp.get_device(device).is_cuda:
        with without_collection(), wp.ScopedCapture(device=device) as capture:
            many()

        def many() -> None:
            wp.capture_launch(capture.graph)

        many()
    return float(np.median([elapsed_ms(many, wait) for _ in range(_TRIALS)])) / _REPEATS


def launch_time(device: str, count: int) -> float:
    """Median time [ms] of so many launches of nothing, each of which waits for the one before it."""
    launch = wp.launch(_nothing, dim=1, device=device, record_cmd=True)
    return pass_time(lambda: [launch.launch() for _ in range(count)], device)


@wp.kernel(module="unique")
def _nothing():
    pass


def bandwidth(device: str) -> float:
    """Bytes a second that a copy reads and writes on the device [B/s]."""
    size = _COPY_BYTES["cuda" if wp.get_device(device).is_cuda else "cpu"]
    source, target = (wp.zeros(size // 4, dtype=wp.float32, device=device) for _ in range(2))
    return 2.0 * size / (1e-3 * pass_time(lambda: wp.copy(target, source), device))
