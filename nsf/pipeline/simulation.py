"""Full-order trajectories onto disk: the solver goes on while threads write what it made."""

import contextlib
import os
import queue
import time
from collections.abc import Callable, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field

import numpy as np

from nsf.data import TrajectoryWriter
from nsf.errors import InstabilityError
from nsf.mpm import FullOrderMPM, Precision, diagnosed
from nsf.mpm.recording import blocks, unpacked
from nsf.progress import Progress
from nsf.runs import Run

# Trajectories that are written at once; each holds at most a few blocks of frames in memory.
_WRITERS = min(4, os.cpu_count() or 1)
_BLOCKS = 2


@dataclass
class Job:
    """One trajectory to be made.

    Attributes:
        run: where it is kept.
        label: what the progress bar says.
        parameters: problem parameters.
        build: gives the solver at t = 0.
    """

    run: Run
    label: str
    parameters: dict[str, float]
    build: Callable[[], FullOrderMPM]
    blocks: queue.Queue = field(default_factory=lambda: queue.Queue(_BLOCKS))


@dataclass(frozen=True)
class _Shared:
    """What the jobs have in common; see `simulate`."""

    steps: int
    dx: float
    stored: Precision
    device: str
    precision: str


def simulate(
    jobs: Iterable[Job],
    steps: int,
    dx: float,
    stored: Precision,
    device: str,
    precision: str,
    say: Callable[[str], object],
) -> int:
    """Run and store every job; each file appears when it is whole.

    Processes that are given the same jobs share them: what another one is making is left to it, and waited
    for at the end.

    Args:
        jobs: trajectories to be made.
        steps: of each, one frame a step and one at t = 0.
        dx: grid spacing [m], for the file.
        stored: precision of the stored frames.
        device, precision: of the physics, for the manifest.
        say: told which trajectory is waited for.

    Returns:
        How many were made here.

    Raises:
        InstabilityError: a particle became non-finite or left the grid.
        StorageError: the disk refused a file.
        KeyboardInterrupt: passed on; what is whole stays, what is not is removed.
    """
    jobs = list(jobs)
    shared = _Shared(steps, dx, stored, device, precision)
    with (
        ThreadPoolExecutor(_WRITERS) as pool,
        Progress("simulate", len(jobs) * (steps + 1), "frames") as progress,
    ):
        writing: list[Future] = []
        for wait in (None, say):
            left = []
            for job in jobs:
                with contextlib.ExitStack() as claim:
                    if not claim.enter_context(job.run.claimed(wait)):
                        left.append(job)
                    elif not job.run.complete:
                        progress.describe(job.label)
                        writing.append(_start(job, claim, pool, shared, progress))
            jobs = left
        for future in writing:
            future.result()
    return len(writing)


def _start(
    job: Job, claim: contextlib.ExitStack, pool: ThreadPoolExecutor, shared: _Shared, progress: Progress
) -> Future:
    """Compute one trajectory while its writer, which takes the claim over, and those of earlier ones work."""
    solver = job.build()
    try:
        stored_by = pool.submit(_store, job, claim.pop_all(), solver, shared)
        started = time.perf_counter()
        try:
            for block in blocks(solver, shared.steps, shared.stored, after=progress.advance):
                _hand_over(job, block, stored_by)
        except InstabilityError as error:
            raise diagnosed(error, job.build, solver.steps_taken) from error
        _hand_over(job, time.perf_counter() - started, stored_by)
    except BaseException as error:
        # The writer leaves no half-written file, and its manifest says what happened.
        _stop(job, error)
        raise
    return stored_by


def _hand_over(job: Job, item, stored_by: Future) -> None:
    """Wait for room in the queue, unless the writer has stopped."""
    while not stored_by.done():
        try:
            job.blocks.put(item, timeout=0.1)
            return
        except queue.Full:
            continue
    stored_by.result()


def _stop(job: Job, error: BaseException) -> None:
    """Tell the writer to give up, at once: nothing here may block, or a second interrupt would hang it."""
    while not job.blocks.empty():
        with contextlib.suppress(queue.Empty):
            job.blocks.get_nowait()
    job.blocks.put_nowait(error)


def _store(job: Job, claim: contextlib.ExitStack, solver: FullOrderMPM, shared: _Shared) -> None:
    constants = solver.constants
    with claim, job.run.record(device=shared.device, precision=shared.precision) as record:
        writer = TrajectoryWriter(
            job.run.path / "trajectory.h5",
            X=constants.X,
            mass=constants.mass,
            volume0=constants.volume0,
            parameters=job.parameters,
            dt=solver.dt,
            dx=shared.dx,
            frames=shared.steps + 1,
            dtype=np.dtype(shared.stored.numpy).name,
        )
        n = 0
        with writer:
            while not isinstance(item := job.blocks.get(), float):
                if isinstance(item, BaseException):
                    raise item
                for frame in item:
                    writer.append(n * solver.dt, *unpacked(frame))
                    n += 1
            writer.cost.update(seconds=item, bytes=solver.nbytes)
        record.metrics["seconds"] = item
        record.output("trajectory.h5")
