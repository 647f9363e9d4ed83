"""The stage `deploy`: reduced runs of the held-out cases, and the lines that a user is told of them."""

import shutil
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from omegaconf import OmegaConf

from nsf.data import Case
from nsf.data.schema import TRAJECTORY
from nsf.deployment import (
    PROJECTED,
    Fallback,
    Rollout,
    Trust,
    calibrate,
    continuation_file,
    deploy,
    go_on,
    rollout_file,
)
from nsf.deployment.trust import CaseDistance, LatentDistance, SolidsRange
from nsf.dynamics import ReducedBatch, ReducedMPM
from nsf.kinematics.manifold import Manifold
from nsf.models import Auto, FullOrder, Projected
from nsf.mpm.stability import largest_stable_dt, multiplied_step_warning
from nsf.pipeline.stages.choosing import measure_candidates
from nsf.recurrence.solids import collider_states
from nsf.runs import Record, Run
from nsf.storage import writing

#: File of a deploy run with the configuration of its whole chain, interpolations kept.
CONFIGURATION = "configuration.yaml"


def deploy_held_out(pipeline, run: Run) -> None:
    """Deploy a pipeline's held-out cases; rollouts and the configuration of its chain go into the run.

    Args:
        pipeline: a `nsf.pipeline.Pipeline`.
        run: its deploy run.
    """
    warn_of_step(pipeline)
    measured = measure_candidates(pipeline) if isinstance(pipeline.configured, Auto) else []
    manifold = pipeline.manifold().to(pipeline.device)  # many solvers take their rows from it
    with run.record(device=pipeline.device, precision=pipeline.config.precision) as record:
        record.metrics |= {"model": pipeline.model.name, "candidates": [one.plain for one in measured]}
        full = isinstance(pipeline.model, FullOrder)
        rollouts = _full_order(pipeline, manifold, record) if full else _rollouts(pipeline, manifold, record)
        for index, rollout in enumerate(rollouts):
            rollout.save(record.path / rollout_file(index))
            record.output(rollout_file(index))
            for line in _told(rollout):
                pipeline.say(f"deploy: {line}")
            if full:
                truth = pipeline.truth(rollout.case).file(TRAJECTORY)
                shutil.copyfile(truth, record.path / continuation_file(index))
                record.output(continuation_file(index))
            elif rollout.handed_over >= 0:
                solver = pipeline.solver_at(manifold, rollout.case)
                if beyond := go_on(solver, rollout, record.path / continuation_file(index), pipeline.stored):
                    pipeline.say(
                        f"deploy: warning: {rollout.case.named}: at the hand-over the stress of {beyond} "
                        "particles was beyond what the law carries, and was scaled down to that"
                    )
                record.output(continuation_file(index))
        write_configuration(pipeline, record)
        record.metrics["seconds"] = [r.seconds for r in rollouts]
        record.metrics["by_latent_model"] = [r.by_latent_model for r in rollouts]
        record.metrics["needed_outside"] = max(r.needed_outside for r in rollouts)
        record.metrics["diverged"] = [r.case.column for r in rollouts if r.diverged >= 0]
        record.metrics["distrusted"] = [r.case.column for r in rollouts if r.distrusted >= 0]
    together = record.metrics["batch"]
    at_once = f", {together} together" if together > 1 else ""
    pipeline.say(
        f"deploy: model={pipeline.model.name}, |S|={rollouts[0].sample}, "
        f"{len(rollouts)} cases{at_once} → {run.id}"
    )


def warn_of_step(pipeline) -> None:
    """Say so where the reduced step of a pipeline is far too long for a case."""
    scenes = map(pipeline.deployed.at, pipeline.held_out)
    stable = min(largest_stable_dt(at.particles(), at.initial_velocity(), at.dx) for at in scenes)
    if line := multiplied_step_warning(pipeline.config.deploy.dt_multiplier, pipeline.deployed.dt, stable):
        pipeline.say(f"deploy: warning: {line}")


def write_configuration(pipeline, record: Record) -> None:
    """Write the configuration of a pipeline's whole chain into the folder of a run."""
    # config.yaml is resolved, so in it no key follows another value of a problem parameter.
    with writing(record.path / CONFIGURATION) as partial:
        OmegaConf.save(pipeline.template, partial)
    record.output(CONFIGURATION)


def trust_of(run: Run, manifold: Manifold, particles: np.ndarray, pipeline) -> Trust:
    """The trust estimate of a deploy run, with the scales that it calibrated.

    Args:
        run: complete.
        manifold: that it deployed.
        particles: [s] indices of S, of all spans of time.
        pipeline: the chain that the run is part of.
    """
    residual, distance = (run.metric("trust", scale) for scale in ("residual_m", "distance_m"))
    latent_distance = LatentDistance(manifold, particles, pipeline.device)
    forcing = _range_of_gravity(pipeline.scene), _range_of_solids(pipeline)
    return Trust(residual, distance, latent_distance, CaseDistance(manifold), *forcing)


def calibrated(pipeline, manifold: Manifold) -> Trust:
    """The trust estimate of a pipeline's runs, calibrated on projected runs of training if it takes any."""
    projected = partial(pipeline.solver_at, manifold, engine=pipeline.projecting)

    def training_run(values: Mapping[str, float], device: str) -> ReducedMPM:
        """A run in the training case of some parameters, with its own program."""
        return projected(_case_of(pipeline.split.train, values), device)

    projects = pipeline.model.projects or pipeline.config.fallback == "projected"
    trust = calibrate(training_run, manifold, pipeline.device, projects)
    return replace(trust, gravity=_range_of_gravity(pipeline.scene), solids=_range_of_solids(pipeline))


def _range_of_gravity(scene) -> tuple[Sequence[float], float] | None:
    """Middle [3] and radius [m/s²] of what a scene's programs of gravity may give; None without any."""
    return (scene.base_gravity, scene.forcing.reach(scene.base_gravity)) if scene.forcing.gravity else None


def _range_of_solids(pipeline) -> SolidsRange | None:
    """Motions of the solids by programs of training; None where they move none."""
    scene = pipeline.scene
    if not scene.forcing.colliders:
        return None
    runs = [scene.at(case).solids for case in pipeline.split.train]
    return SolidsRange(np.stack([collider_states(run, scene.dt, scene.steps) for run in runs]), scene.dt)


def _calibrated(pipeline, manifold: Manifold, record: Record) -> Trust:
    """The trust estimate, whose scales go on record."""
    started = time.perf_counter()
    trust = calibrated(pipeline, manifold)
    record.metrics["trust"] = {
        "residual_m": trust.residual,
        "distance_m": trust.distance,
        "seconds": time.perf_counter() - started,
    }
    return trust


def _rollouts(pipeline, manifold: Manifold, record: Record) -> list[Rollout]:
    """The reduced runs; how far they may be believed, and who takes their steps, go on record."""
    keys, trust = pipeline.config.deploy, _calibrated(pipeline, manifold, record)
    # Runs that take their steps together share the time of these equally.
    together = record.metrics["batch"] = min(keys.batch, len(pipeline.held_out))

    def batch_at(cases: Sequence[Case], device: str) -> ReducedBatch:
        batch = pipeline.batch_at(manifold, cases, device)
        record.metrics |= {"engine": batch.engine, "engine_why": batch.why}
        return batch

    fallback = fallback_of(pipeline, manifold)
    rollouts = deploy(batch_at, pipeline.held_out, pipeline.device, trust, fallback, together)
    engine, why = record.metrics["engine"], record.metrics["engine_why"]
    if isinstance(pipeline.model, Projected):
        pipeline.say(f"deploy: steps by {engine}" + (f", since {why}" if why else ""))
    return rollouts


def _full_order(pipeline, manifold: Manifold, record: Record) -> list[Rollout]:
    """Runs that the full-order solver takes from t = 0; their trajectories are those of `simulate`."""
    runs, rollouts = pipeline.full_order(pipeline.held_out), []
    record.metrics |= {"engine": "full", "engine_why": "", "batch": 1}
    _calibrated(pipeline, manifold, record)
    for case, run in zip(pipeline.held_out, runs, strict=True):
        solver = pipeline.solver_at(manifold, case)
        rollouts.append(
            Rollout(
                case=case,
                t=np.zeros(1),
                xhat=solver.trajectory().xhat,
                residuals=np.zeros((0, solver.setup.projector.iterations + 1)),
                stops=[],
                trust=np.zeros(1),
                away=0.0,
                sample=solver.sample_size,
                integration_mean=solver.integration_mean,
                needed_outside=0,
                seconds=run.metric("seconds"),
                diverged=-1,
                handed_over=0,
            )
        )
    return rollouts


def _case_of(cases: Sequence[Case], values: Mapping[str, float]) -> Case:
    """The first case with these parameters."""
    return next(case for case in cases if case.parameters == dict(values))


def fallback_of(pipeline, manifold: Manifold) -> Fallback:
    """Who goes on with a run of the pipeline that is no longer believed."""
    to = pipeline.config.fallback
    if isinstance(pipeline.model, Projected):
        return Fallback(to)
    return Fallback(to, partial(pipeline.batch_at, manifold, engine=pipeline.projecting))


def _told(rollout: Rollout) -> list[str]:
    """Lines for the user: who went on with a run, and why it is not to be believed."""
    lines, t, named = [], rollout.t, rollout.case.named
    projected = np.flatnonzero(rollout.levels == PROJECTED)
    if rollout.by is not None and len(projected):
        lines.append(
            f"{named}: the projected step takes {len(projected)} of {len(rollout.stops)} steps, "
            f"the first at t = {t[projected[0]]:.4g} s"
        )
    if rollout.diverged >= 0:
        lines.append(
            f"warning: {named} diverged at step {rollout.diverged} (off the grid or not finite); "
            "its errors are reported as ∞"
        )
    if (step := rollout.distrusted) >= 0:
        why = f"left what the model was trained on at t = {t[step]:.4g} s"
        far = f"{rollout.trust.max():.3g} times as far as training data are from themselves"
        if rollout.away > 1.0:
            why = "is none of the cases that the model was trained for"
            far = f"{rollout.away:.3g} times as far from them as they are from each other"
        then = f": {far}"
        if rollout.handed_over >= 0:
            then = f"; the full-order solver goes on from t = {t[rollout.handed_over]:.4g} s"
        lines.append(f"warning: {named} {why}{then}")
    if rollout.needed_outside:
        lines.append(
            f"warning: {named}: a step needed {rollout.needed_outside} particles or nodes "
            "outside the superset or the grid; raise integration.margin or use integration=search"
        )
    return lines
