"""Time and memory of the full-order and the reduced solver, both measured in one process."""

import gc
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch

from nsf.deployment import Rollout
from nsf.dynamics import ReducedMPM
from nsf.evaluation.compare import at_frames
from nsf.timing import MemoryProbe, StageTimer, elapsed_ms, synchronizer

_WARM_UP = 2  # steps of a fresh solver that compile, load and capture everything


@dataclass(frozen=True)
class Subject:
    """A solver to be timed.

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
        total_ms: median over the trials of the time of all steps of a run, the first ones, which load
            and capture, included [ms]; building the solver is not.
        stages: median over steps spread through a run of each stage's time [ms]; on a GPU within the
            captured step, where steps are captured, else synchronised, so that their sum may exceed a step.
        memory_mib: peak of every allocator during the first run, beyond what was held before it [MiB].
        trials: number of runs; steps: of each.
    """

    step_ms: float
    step_ms_p10: float
    step_ms_p90: float
    total_ms: float
    stages: dict[str, float]
    memory_mib: float
    trials: int
    steps: int


def measure(
    subjects: dict[str, Subject],
    trials: int,
    device: str,
    advance: Callable[[], object] = lambda: None,
) -> dict[str, SolverCost]:
    """Whole runs of every solver, turn by turn, so that a machine that slows down slows all of them.

    Args:
        subjects: by name.
        trials: runs of each.
        device: `cpu`, `cuda` or `cuda:N`.
        advance: called after each run; of each solver there is one more, in which stages are timed.
    """
    memory: dict[str, float] = {}
    times: dict[str, list[tuple[float, float]]] = {name: [] for name in subjects}
    for trial in range(trials):
        for name, subject in subjects.items():
            if trial == 0:
                taken, memory[name] = _first_trial(subject, device)
            else:
                taken = _times(subject.build(), subject.steps, device)
            times[name].append(taken)
            advance()
    costs = {}
    for name, subject in subjects.items():
        steps, totals = np.array(times[name]).T
        p10, median, p90 = np.percentile(steps, [10, 50, 90]).tolist()
        costs[name] = SolverCost(
            step_ms=median,
            step_ms_p10=p10,
            step_ms_p90=p90,
            total_ms=float(np.median(totals)),
            stages=_stages(subject, trials, device),
            memory_mib=memory[name],
            trials=trials,
            steps=subjects[name].steps,
        )
        advance()
    return costs


def decoding_ms(solver: ReducedMPM, rollout: Rollout, trials: int) -> float:
    """Median time to decode the positions of all particles at every frame of a reduced run [ms], in fp32.

    They stay on the device, as those of the full-order solver do.

    Args:
        solver: of the run.
        rollout: the run; its latent vectors are taken at the full-order frames.
        trials: decodings of all frames, after one that is not timed.
    """
    setup, scene = solver.setup, solver.scene
    frames = at_frames(rollout, scene.dt * np.arange(scene.steps + 1))
    xhat = torch.as_tensor(frames, dtype=torch.float32, device=setup.torch_device)
    at = solver.manifold.restrict(dtype=torch.float32, device=setup.torch_device)
    wait = synchronizer(str(setup.torch_device))

    def decode() -> None:
        for _ in at.positions(xhat):
            pass

    return float(np.median([elapsed_ms(decode, wait) for _ in range(trials + 1)][1:]))


def _first_trial(subject: Subject, device: str) -> tuple[tuple[float, float], float]:
    """Times as `_times`, and peak memory beyond what was held before [MiB]."""
    gc.collect()  # what an earlier solver left behind; slow, so only where memory is measured
    with MemoryProbe(device) as before:
        pass
    solver = subject.build()
    gc.collect()
    with MemoryProbe(device, nbytes=lambda: solver.nbytes) as probe:
        taken = _times(solver, subject.steps, device)
    return taken, probe.peak_mib - before.peak_mib


def _times(solver, steps: int, device: str) -> tuple[float, float]:
    """Mean time of a step over a whole run, those that warm up left out, and time of all steps [ms]."""
    wait, warm = synchronizer(device), min(_WARM_UP, steps - 1)
    first, rest = (elapsed_ms(lambda n=n: solver.step(n), wait) for n in (warm, steps - warm))
    return rest / (steps - warm), first + rest


def _stages(subject: Subject, samples: int, device: str) -> dict[str, float]:
    """Median time of each stage [ms] over steps spread evenly through a run."""
    solver = subject.build()
    chosen = np.unique(np.linspace(min(_WARM_UP, subject.steps - 1), subject.steps - 1, samples).astype(int))
    times: dict[str, list[float]] = {}
    taken = 0
    for step in chosen.tolist():
        solver.step(step - taken)
        timer = StageTimer(device)
        solver.timed_step(timer)
        taken = step + 1
        for name, ms in timer.per_step(1).items():
            times.setdefault(name, []).append(ms)
    return {name: float(np.median(values)) for name, values in times.items()}
