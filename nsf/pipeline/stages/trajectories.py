"""Full-order trajectories onto disk, side by side on a CPU; the solver goes on while threads write.

A helping process imports no more than this module does: without torch and Hydra it works within a second.
"""

import contextlib
import os
import queue
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from itertools import chain
from pathlib import Path
from typing import NamedTuple

import numpy as np

from nsf.data import Case, TrajectoryWriter
from nsf.data.motion import motion_warnings
from nsf.data.schema import TRAJECTORY
from nsf.errors import InstabilityError
from nsf.mpm import FullOrderMPM, ParticleConstants, Precision, diagnosed
from nsf.mpm.recording import HostMemory, blocks
from nsf.pipeline.stages.cores import Advance, helping
from nsf.progress import Progress
from nsf.runs import Run

# Trajectories that are written at once; each holds about ten blocks of frames (64 MiB) at most.
_WRITERS = min(8, os.cpu_count() or 1)
_BLOCKS = 8


@dataclass
class Job:
    """One trajectory to be made.

    Attributes:
        run: where it is kept.
        case: problem parameters.
        build: gives the solver at t = 0.
        forcing: what forces it at each frame, for the file.
        warnings: for the run's manifest.
    """

    run: Run
    case: Case
    build: Callable[[], FullOrderMPM]
    forcing: Mapping[str, np.ndarray]
    warnings: Sequence[str] = ()


@dataclass(frozen=True)
class Shared:
    """Values that all jobs share.

    Attributes:
        steps: of each; every: steps from a frame to the next, the first at t = 0.
        dx: grid spacing [m], for the file.
        stored: precision of the stored frames.
        device, precision: of the physics, for the manifest.
        helpers: how many processes make the trajectories, each a share; 0 where this one does.
    """

    steps: int
    every: int
    dx: float
    stored: Precision
    device: str
    precision: str
    helpers: int = 0

    @property
    def frames(self) -> int:
        """Of each."""
        return self.steps // self.every + 1


class Cost(NamedTuple):
    """Cost of a trajectory, under the names of its file: wall time [s], and memory of the device [byte]."""

    seconds: float
    bytes: int


class Ending(NamedTuple):
    """The end of a trajectory's file after its last frame: its cost, and warnings."""

    cost: Cost
    warnings: Sequence[str]


def simulate(
    jobs: Sequence[Job],
    shared: Shared,
    say: Callable[[str], object],
    begun=None,
    meanwhile: Callable[[], object] = lambda: None,
) -> int:
    """Run and store every job; each file appears when it is whole.

    Processes with the same jobs share them: what another one is making is left to it, and waited for at the
    end. Files are the same, bit for bit, whoever makes them.

    Args:
        jobs: trajectories to be made.
        shared: what they have in common.
        say: called with a line on a trajectory that is waited for, or where something was odd.
        begun: the helping processes, where they were started ahead (`nsf.pipeline.stages.cores.ahead`).
        meanwhile: called here while the helpers work; where it raises, they stop.

    Returns:
        How many were made, here and by the helpers.

    Raises:
        InstabilityError: law or step of a run no longer hold, see `FullOrderMPM.check`.
        StorageError: the disk refused a file.
        KeyboardInterrupt: passed on; what is whole stays, what is not is removed.
    """
    progress = Progress("simulate", len(jobs) * shared.frames, "frames")
    help_with = partial(_help, jobs, shared)
    with helping(help_with, shared.helpers, progress.advance, begun) as helpers:
        meanwhile()
        with progress, ThreadPoolExecutor(_WRITERS) as writers:
            share = partial(
                _share, shared=shared, pool=writers, memory=HostMemory(), advance=progress.advance, say=say,
                describe=progress.describe,
            )  # fmt: skip
            writing, left = ([], jobs) if shared.helpers else share(jobs)
            ended = helpers.results()
            for line in chain.from_iterable(lines for _, lines in ended):
                say(line)
            writing += share(left, wait=True)[0]
            for future in writing:
                future.result()
    return len(writing) + sum(count for count, _ in ended)


def _help(
    jobs: Sequence[Job], shared: Shared, number: int, advance: Advance, folder: Path
) -> tuple[int, list[str]]:
    """Make what no other process makes, each helper from elsewhere on; how many, and lines for the user."""
    begin, lines = number * len(jobs) // shared.helpers, []
    with ThreadPoolExecutor(_WRITERS) as pool:
        order = [*jobs[begin:], *jobs[:begin]]
        writing, _ = _share(order, shared, pool, HostMemory(), advance, lines.append)
        for future in writing:
            future.result()
    return len(writing), lines


def _share(
    jobs: Sequence[Job],
    shared: Shared,
    pool: ThreadPoolExecutor,
    memory: HostMemory,
    advance: Advance,
    say: Callable[[str], object],
    describe: Callable[[str], object] = lambda case: None,
    wait: bool = False,
) -> tuple[list[Future], list[Job]]:
    """Compute each job that is not there; the writers at work, and the jobs that other processes make."""
    writing, left = [], []
    for job in jobs:
        with contextlib.ExitStack() as claim:
            if not claim.enter_context(job.run.claimed(say if wait else None)):
                left.append(job)
            elif not job.run.complete:
                describe(job.case.named)
                writing.append(_start(job, claim, pool, shared, advance, memory, say))
    return writing, left


def _start(
    job: Job,
    claim: contextlib.ExitStack,
    pool: ThreadPoolExecutor,
    shared: Shared,
    advance: Advance,
    memory: HostMemory,
    say: Callable[[str], object],
) -> Future:
    """Compute one trajectory while its writer, which takes the claim over, and those of earlier ones work."""
    solver, frames = job.build(), queue.Queue(_BLOCKS)
    try:
        # Not the solver: who drops it last frees memory of a GPU, and no graph may be captured meanwhile.
        stored_by = pool.submit(_store, job, frames, claim.pop_all(), solver.constants, solver.dt, shared)
        started = time.perf_counter()
        try:
            for block in blocks(solver, shared.steps, shared.stored, advance, memory, shared.every):
                _hand_over(frames, block, stored_by)
        except InstabilityError as error:
            raise diagnosed(error, job.build, solver.steps_taken) from error
        cost = Cost(time.perf_counter() - started, solver.nbytes)
        _hand_over(frames, Ending(cost, solver.warnings), stored_by)
        for line in solver.warnings:
            say(f"simulate: warning: {job.case.named}: {line}")
    except BaseException as error:
        # The writer leaves no half-written file, and its manifest says what happened.
        _stop(frames, error)
        raise
    return stored_by


def _hand_over(frames: queue.Queue, item, stored_by: Future) -> None:
    """Wait for room in the queue, unless the writer has stopped."""
    while not stored_by.done():
        try:
            frames.put(item, timeout=0.1)
            return
        except queue.Full:
            continue
    stored_by.result()


def _stop(frames: queue.Queue, error: BaseException) -> None:
    """Tell the writer to give up, at once: nothing here may block, or a second interrupt would hang it."""
    while not frames.empty():
        with contextlib.suppress(queue.Empty):
            frames.get_nowait()
    frames.put_nowait(error)


def _store(
    job: Job,
    frames: queue.Queue,
    claim: contextlib.ExitStack,
    constants: ParticleConstants,
    dt: float,
    shared: Shared,
) -> None:
    about = {"device": shared.device, "precision": shared.precision, "warnings": job.warnings}
    with claim, job.run.record(**about) as record:
        writer = TrajectoryWriter(
            job.run.path / TRAJECTORY,
            X=constants.X,
            mass=constants.mass,
            volume0=constants.volume0,
            parameters=job.case.parameters,
            dt=dt,
            dx=shared.dx,
            frames=shared.frames,
            dtype=np.dtype(shared.stored.numpy).name,
            forcing=job.forcing,
        )
        n = 0
        with writer:
            while not isinstance(item := frames.get(), Ending):
                if isinstance(item, BaseException):
                    raise item
                for frame in item:
                    writer.append(n * dt, **frame)
                    n += shared.every
                last = np.array(frame["x"], float)  # of a block whose memory is taken again
                item.done()
            writer.cost.update(item.cost._asdict())
        record.warn([*item.warnings, *motion_warnings(constants.X, last, shared.dx)])
        record.metrics["seconds"] = item.cost.seconds
        record.output(TRAJECTORY)
