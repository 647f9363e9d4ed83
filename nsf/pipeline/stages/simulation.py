"""Full-order trajectories onto disk: the solver goes on while threads write what it made."""

import contextlib
import os
import queue
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from nsf.data import Case, TrajectoryWriter
from nsf.data.schema import TRAJECTORY
from nsf.errors import InstabilityError
from nsf.mpm import FullOrderMPM, ParticleConstants, Precision, diagnosed
from nsf.mpm.recording import HostMemory, blocks
from nsf.pipeline.checks import check_room
from nsf.progress import Progress
from nsf.runs import Run
from nsf.scenes import Scene
from nsf.scenes.resolution import resolution_warnings

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
        steps: of each, one frame a step and one at t = 0.
        dx: grid spacing [m], for the file.
        stored: precision of the stored frames.
        device, precision: of the physics, for the manifest.
    """

    steps: int
    dx: float
    stored: Precision
    device: str
    precision: str


class Cost(NamedTuple):
    """Cost of a trajectory, under the names of its file: wall time [s], and memory of the device [byte]."""

    seconds: float
    bytes: int


class Ending(NamedTuple):
    """The end of a trajectory's file after its last frame: its cost, and warnings."""

    cost: Cost
    warnings: Sequence[str]


def simulate(jobs: Sequence[Job], shared: Shared, say: Callable[[str], object]) -> int:
    """Run and store every job; each file appears when it is whole.

    Processes that are given the same jobs share them: what another one is making is left to it, and waited
    for at the end.

    Args:
        jobs: trajectories to be made.
        shared: what they have in common.
        say: told which trajectory is waited for, and what was odd in one.

    Returns:
        How many were made here.

    Raises:
        InstabilityError: law or step of a run no longer hold, see `FullOrderMPM.check`.
        StorageError: the disk refused a file.
        KeyboardInterrupt: passed on; what is whole stays, what is not is removed.
    """
    frames = len(jobs) * (shared.steps + 1)
    with Progress("simulate", frames, "frames") as progress, ThreadPoolExecutor(_WRITERS) as pool:
        memory, writing = HostMemory(), []
        for wait in (None, say):
            left = []
            for job in jobs:
                with contextlib.ExitStack() as claim:
                    if not claim.enter_context(job.run.claimed(wait)):
                        left.append(job)
                    elif not job.run.complete:
                        progress.describe(job.case.named)
                        writing.append(_start(job, claim, pool, shared, progress, memory, say))
            jobs = left
        for future in writing:
            future.result()
    return len(writing)


def _start(
    job: Job,
    claim: contextlib.ExitStack,
    pool: ThreadPoolExecutor,
    shared: Shared,
    progress: Progress,
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
            for block in blocks(solver, shared.steps, shared.stored, progress.advance, memory):
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
            frames=shared.steps + 1,
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
                    n += 1
                item.done()
            writer.cost.update(item.cost._asdict())
        record.warn(item.warnings)
        record.metrics["seconds"] = item.cost.seconds
        record.output(TRAJECTORY)


def simulate_missing(pipeline, missing: Collection[Run], warned: Collection[str]) -> None:
    """Make the trajectories of a pipeline that are not there.

    Args:
        pipeline: a `nsf.pipeline.Pipeline`.
        missing: their runs.
        warned: warnings that were said already.
    """
    # A changed scene that changes nothing, or trains on what it deploys, names one run twice.
    runs = {pipeline.simulation(*needed): needed for needed in pipeline.needed()}
    runs = {run: needed for run, needed in runs.items() if run in missing}
    warnings = {run: resolution_warnings(scene.at(case)) for run, (case, scene) in runs.items()}
    for line in dict.fromkeys(line for lines in warnings.values() for line in lines):
        if line not in warned:
            pipeline.say(f"simulate: warning: {line}")
    started = time.perf_counter()
    made = make(pipeline, runs, warnings)
    elsewhere = f", {len(runs) - made} by another process" if made < len(runs) else ""
    pipeline.say(f"simulate: {made} trajectories in {time.perf_counter() - started:.1f} s{elsewhere}")


def make(
    pipeline,
    runs: Mapping[Run, tuple[Case, Scene]],
    warnings: Mapping[Run, Sequence[str]] = MappingProxyType({}),
) -> int:
    """Make trajectories of a pipeline; gives how many were made here.

    Args:
        pipeline: a `nsf.pipeline.Pipeline`.
        runs: to be made, at least one, each with its case and scene.
        warnings: lines of some, for their manifests.
    """
    check_room(pipeline, runs)
    c, device = pipeline.config, pipeline.device

    def job(run: Run, case: Case, scene: Scene) -> Job:
        build = partial(scene.full_order, case, c.precision, device)
        forcing = scene.at(case).forcing_at(scene.dt * np.arange(scene.steps + 1))
        return Job(run, case, build, forcing, warnings.get(run, ()))

    jobs = [job(run, *needed) for run, needed in runs.items()]
    shared = Shared(pipeline.scene.steps, pipeline.scene.dx, pipeline.stored, device, c.precision)
    return simulate(jobs, shared, pipeline.say)
