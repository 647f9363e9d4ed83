"""The stage `simulate`: which full-order trajectories are missing, and how many processes make them."""

import time
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager
from functools import partial
from types import MappingProxyType

import numpy as np

from nsf.data import Case
from nsf.data.motion import FLAT, RIGID, STILL
from nsf.pipeline.stages import cores
from nsf.runs import Run
from nsf.scenes import Scene

#: What helping processes import: Warp, which this one imports while they start.
_WORK = "nsf.pipeline.stages.trajectories"


def helpers_ahead(pipeline, missing: Collection[Run]) -> AbstractContextManager:
    """Helping processes for `simulate_missing`, which begin while this one checks the pipeline."""
    return cores.ahead(_helpers(pipeline, _needed(pipeline, missing).values(), 0), _WORK)


def _needed(pipeline, missing: Collection[Run]) -> dict[Run, tuple[Case, Scene]]:
    # A changed scene that changes nothing, or trains on what it deploys, names one run twice.
    runs = {pipeline.simulation(*needed): needed for needed in pipeline.needed()}
    return {run: needed for run, needed in runs.items() if run in missing}


def _helpers(pipeline, needed: Iterable[tuple[Case, Scene]], nbytes: int) -> int:
    """How many processes make trajectories of so many bytes, each a share; 0 where this one does."""
    further = cores.helper_count(pipeline.device, [scene for _, scene in needed], nbytes)
    return further + 1 if further else 0


def simulate_missing(pipeline, missing: Collection[Run], warned: Collection[str], begun=None) -> int:
    """Make the trajectories of a pipeline that are not there; gives how many were made here.

    Of the pipeline's checks, those of its scenes come before any work, and where processes help the others
    while these work: torch takes more than a second to load.

    Args:
        pipeline: a `nsf.pipeline.Pipeline`.
        missing: their runs.
        warned: warnings that were said already.
        begun: of `helpers_ahead`.
    """
    from nsf.pipeline.checks import check_cases
    from nsf.scenes.resolution import resolution_warnings

    check_cases(pipeline)
    if begun is None:
        pipeline.check()
    runs = _needed(pipeline, missing)
    warnings = {run: resolution_warnings(scene.at(case)) for run, (case, scene) in runs.items()}
    for line in dict.fromkeys(line for lines in warnings.values() for line in lines):
        if line not in warned:
            pipeline.say(f"simulate: warning: {line}")
    started = time.perf_counter()
    made = make(pipeline, runs, warnings, begun, pipeline.check if begun else lambda: None)
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
    meanwhile: Callable[[], object] = lambda: None,
) -> int:
    """Make trajectories of a pipeline; gives how many were made here.

    Args:
        pipeline: a `nsf.pipeline.Pipeline`.
        runs: to be made, at least one, each with its case and scene.
        warnings: lines of some, for their manifests.
        begun: of `helpers_ahead`.
        meanwhile: as of `nsf.pipeline.stages.trajectories.simulate`.
    """
    from nsf.pipeline.checks import check_room
    from nsf.pipeline.stages.trajectories import Job, Shared, simulate
    from nsf.scenes.checks import host_bytes

    check_room(pipeline, runs)
    c, device, every = pipeline.config, pipeline.device, pipeline.config.data.every

    def job(run: Run, case: Case, scene: Scene) -> Job:
        build = partial(scene.full_order, case, c.precision, device)
        forcing = scene.at(case).forcing_at(scene.dt * np.arange(0, scene.steps + 1, every))
        return Job(run, case, build, forcing, warnings.get(run, ()))

    jobs = [job(run, *needed) for run, needed in runs.items()]
    scene, stored = pipeline.scene, pipeline.stored
    count = _helpers(pipeline, runs.values(), host_bytes(scene, c.precision, stored))
    shared = Shared(scene.steps, every, scene.dx, stored, device, c.precision, count)
    return simulate(jobs, shared, pipeline.say, begun, meanwhile)
