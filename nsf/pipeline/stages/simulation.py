"""The stage `simulate`: which full-order trajectories are missing, and how many processes make them."""

import time
from collections.abc import Collection, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager
from functools import partial
from types import MappingProxyType

import numpy as np

from nsf.data import Case
from nsf.data.motion import FLAT, RIGID, STILL
from nsf.pipeline.stages import cores, trajectories
from nsf.pipeline.stages.trajectories import Job, Shared, simulate
from nsf.runs import Run
from nsf.scenes import Scene
from nsf.scenes.checks import host_bytes
from nsf.scenes.resolution import resolution_warnings


def helpers_ahead(pipeline, missing: Collection[Run]) -> AbstractContextManager:
    """Helping processes for `simulate_missing`, which begin while this one checks the pipeline."""
    count = _helpers(pipeline, (scene for _, scene in _needed(pipeline, missing).values()))
    return cores.ahead(count, trajectories.__name__)


def _needed(pipeline, missing: Collection[Run]) -> dict[Run, tuple[Case, Scene]]:
    # A changed scene that changes nothing, or trains on what it deploys, names one run twice.
    runs = {pipeline.simulation(*needed): needed for needed in pipeline.needed()}
    return {run: needed for run, needed in runs.items() if run in missing}


def _helpers(pipeline, scenes: Iterable[Scene]) -> int:
    size = host_bytes(pipeline.scene, pipeline.config.precision, pipeline.stored)
    return cores.helper_count(pipeline.device, list(scenes), size)


def simulate_missing(pipeline, missing: Collection[Run], warned: Collection[str], begun=None) -> int:
    """Make the trajectories of a pipeline that are not there; gives how many were made here.

    Args:
        pipeline: a `nsf.pipeline.Pipeline`.
        missing: their runs.
        warned: warnings that were said already.
        begun: of `helpers_ahead`.
    """
    runs = _needed(pipeline, missing)
    warnings = {run: resolution_warnings(scene.at(case)) for run, (case, scene) in runs.items()}
    for line in dict.fromkeys(line for lines in warnings.values() for line in lines):
        if line not in warned:
            pipeline.say(f"simulate: warning: {line}")
    started = time.perf_counter()
    made = make(pipeline, runs, warnings, begun)
    elsewhere = f", {len(runs) - made} by another process" if made < len(runs) else ""
    pipeline.say(f"simulate: {made} trajectories in {time.perf_counter() - started:.1f} s{elsewhere}")
    odd = [line for run in runs for line in run.manifest.get("warnings", ()) if line in (STILL, RIGID, FLAT)]
    for line in dict.fromkeys(odd):
        pipeline.say(f"simulate: warning: in {odd.count(line)} of {len(runs)} runs {line}")
    return made


def make(
    pipeline,
    runs: Mapping[Run, tuple[Case, Scene]],
    warnings: Mapping[Run, Sequence[str]] = MappingProxyType({}),
    begun=None,
) -> int:
    """Make trajectories of a pipeline; gives how many were made here.

    Args:
        pipeline: a `nsf.pipeline.Pipeline`.
        runs: to be made, at least one, each with its case and scene.
        warnings: lines of some, for their manifests.
        begun: of `helpers_ahead`.
    """
    from nsf.pipeline.checks import check_room

    check_room(pipeline, runs)
    c, device, every = pipeline.config, pipeline.device, pipeline.config.data.every

    def job(run: Run, case: Case, scene: Scene) -> Job:
        build = partial(scene.full_order, case, c.precision, device)
        forcing = scene.at(case).forcing_at(scene.dt * np.arange(0, scene.steps + 1, every))
        return Job(run, case, build, forcing, warnings.get(run, ()))

    jobs = [job(run, *needed) for run, needed in runs.items()]
    count, own = _helpers(pipeline, (scene for _, scene in runs.values())), pipeline.scene
    shared = Shared(own.steps, every, own.dx, pipeline.stored, device, c.precision, count)
    return simulate(jobs, shared, pipeline.say, begun)
