"""The stage `deploy`: reduced runs of the held-out cases, bounds of their errors, and who takes red ones."""

import shutil
import time
from collections.abc import Sequence
from functools import partial

import numpy as np
from omegaconf import OmegaConf

from nsf.data import Case
from nsf.data.schema import TRAJECTORY
from nsf.deployment import (
    FLAGS,
    FULL_ORDER,
    GREEN,
    PROJECTED,
    RED,
    TRUST,
    Rollout,
    Trust,
    Verdict,
    continuation_file,
    deploy,
    rollout_file,
)
from nsf.deployment.bound import ENOUGH, widening
from nsf.deployment.trust import percent
from nsf.dynamics import ReducedBatch
from nsf.kinematics.manifold import Manifold
from nsf.models import Auto, FullOrder, Projected
from nsf.mpm.stability import largest_stable_dt, multiplied_step_warning
from nsf.pipeline.stages.calibration import CALIBRATES, calibrated
from nsf.pipeline.stages.choosing import measure_candidates
from nsf.progress import START, seconds_of
from nsf.runs import Record, Run
from nsf.storage import writing

_WIDE = 1.1  # factor on error bounds from which more validation cases are worth their runs
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
    begun = time.monotonic()
    manifold = pipeline.manifold().to(pipeline.device)  # many solvers take their rows from it
    with run.record(device=pipeline.device, precision=pipeline.config.precision) as record:
        record.metrics |= {"model": pipeline.model.name, "candidates": [one.plain for one in measured]}
        trust = calibrated(pipeline, manifold)
        trust.save(record.path / TRUST)
        record.output(TRUST)
        runs = len(trust.calibration.errors) if trust.calibration else 0
        if runs and runs == len(pipeline.validating.held_out):  # else the worst of them do not count
            record.metrics["validation_error"] = float(trust.calibration.errors.mean())
        if runs and widening(runs) >= _WIDE:
            pipeline.say(
                f"deploy: {runs} validation run{'s' * (runs > 1)} set the error bounds, which are "
                f"{widening(runs):.2g} times as wide as of {ENOUGH}; add cases to scene.design.validation"
            )
        if isinstance(pipeline.model, FullOrder):
            record.metrics |= {"engine": "full", "engine_why": "", "batch": 1}
            rollouts = _full_order(pipeline, manifold, pipeline.held_out, trust.limit)
        else:
            rollouts = _first_runs(pipeline, manifold, trust, record, begun)
            rollouts = _taken_over(pipeline, manifold, rollouts)
        for index, rollout in enumerate(rollouts):
            rollout.save(record.path / rollout_file(index))
            record.output(rollout_file(index))
            if rollout.by == FULL_ORDER:
                truth = pipeline.truth(rollout.case).file(TRAJECTORY)
                shutil.copyfile(truth, record.path / continuation_file(index))
                record.output(continuation_file(index))
        validating = pipeline.config.deploy.split == "validation"
        for line in _lines(rollouts, validating):
            pipeline.say(f"deploy: {'validation: ' * validating}{line}")
        write_configuration(pipeline, record)
        flags, bound = zip(*((r.verdict.flag, r.verdict.bound_share) for r in rollouts), strict=True)
        record.metrics["seconds"] = [r.seconds for r in rollouts]
        record.metrics["by"] = [r.by for r in rollouts]
        record.metrics["needed_outside"] = max(r.needed_outside for r in rollouts)
        record.metrics["diverged"] = [r.case.column for r in rollouts if r.diverged >= 0]
        record.metrics["flags"] = {flag: flags.count(flag) for flag in FLAGS}
        lights = ", ".join(f"{flags.count(flag)} {flag}" for flag in FLAGS if flag in flags)
        most = "" if np.isnan(bound).all() else f": ≤ {percent(np.nanmax(bound))}"
        record.metrics["light"] = lights + most
    together = record.metrics["batch"]
    at_once = f", {together} together" if together > 1 else ""
    pipeline.say(
        f"deploy: model={pipeline.model.name}, |S|={rollouts[0].sample}, "
        f"{len(rollouts)} {'validation ' * validating}cases{at_once} → {run.id}"
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


def _first_runs(pipeline, manifold: Manifold, trust: Trust, record: Record, begun: float) -> list[Rollout]:
    """The reduced runs of the configured model, of a stage that was begun at a time of the clock [s]."""
    # Runs that take their steps together share the time of these equally.
    together = record.metrics["batch"] = min(pipeline.config.deploy.batch, len(pipeline.held_out))

    def batch_at(cases: Sequence[Case], device: str) -> ReducedBatch:
        batch = pipeline.batch_at(manifold, cases, device)
        record.metrics |= {"engine": batch.engine, "engine_why": batch.why}
        return batch

    def stepped() -> None:
        record.metrics.setdefault("ready_seconds", seconds_of(START) + time.monotonic() - begun)

    rollouts = deploy(batch_at, pipeline.held_out, pipeline.device, trust, together, stepped)
    engine, why = record.metrics["engine"], record.metrics["engine_why"]
    if isinstance(pipeline.model, Projected):
        pipeline.say(f"deploy: steps by {engine}" + (f", since {why}" if why else ""))
    return rollouts


def _taken_over(pipeline, manifold: Manifold, rollouts: list[Rollout]) -> list[Rollout]:
    """The runs, those that are red by the fallback from their beginning."""
    to, name = pipeline.config.fallback, pipeline.model.name
    red = [index for index, rollout in enumerate(rollouts) if rollout.verdict.flag == RED]
    if to == "none" or not red:
        return rollouts
    for index in red:
        one = rollouts[index]
        pipeline.say(f"deploy: {one.case.named} goes to {to}, since {name} is {one.verdict.text}")
    cases = [rollouts[index].case for index in red]
    if to == FULL_ORDER:
        pipeline.full_order(cases)
        others = _full_order(pipeline, manifold, cases, rollouts[0].verdict.limit)
    else:
        other = pipeline.projected
        trust = calibrated(other, manifold)
        others = deploy(partial(other.batch_at, manifold), cases, pipeline.device, trust)
        for rollout in others:
            rollout.by = PROJECTED
    taken = dict(zip(red, others, strict=True))
    return [taken.get(index, rollout) for index, rollout in enumerate(rollouts)]


def _full_order(pipeline, manifold: Manifold, cases: Sequence[Case], limit: float) -> list[Rollout]:
    """Runs that the full-order solver takes from t = 0; their trajectories are those of `simulate`."""
    runs, rollouts, none = pipeline.full_order(cases), [], np.zeros(1)
    for case, run in zip(cases, runs, strict=True):
        solver = pipeline.solver_at(manifold, case)
        rollouts.append(
            Rollout(
                case=case,
                t=none,
                xhat=solver.trajectory().xhat,
                residuals=np.zeros((0, solver.setup.projector.iterations + 1)),
                stops=[],
                signal=none,
                verdict=Verdict(none, none, 0.0, limit),
                sample=solver.sample_size,
                integration_mean=solver.integration_mean,
                needed_outside=0,
                seconds=run.metric("seconds"),
                diverged=-1,
                by=FULL_ORDER,
            )
        )
    return rollouts


def _lines(rollouts: Sequence[Rollout], validating: bool) -> list[str]:
    """Lines for the user: whether runs are to be believed, green ones in one line, and what went wrong."""
    greens = [one.verdict for one in rollouts if one.verdict.flag == GREEN and not one.by]
    together = len(greens) > 1
    lines = [
        line
        for one in rollouts
        for line in _of_run(one, not together or one.verdict.flag != GREEN or bool(one.by), validating)
    ]
    if not together:
        return lines
    expected = [verdict.error_share for verdict in greens]
    most = percent(max(verdict.bound_share for verdict in greens))
    errors = f"expected error {percent(min(expected))} to {percent(max(expected))}, at most {most}"
    return [f"{len(greens)} runs are green: {errors}", *lines]


def _of_run(rollout: Rollout, light: bool, validating: bool) -> list[str]:
    named = rollout.case.named
    by = f" by {rollout.by}" if rollout.by else ""
    light = light and rollout.verdict.reason != CALIBRATES
    aside = "; error bounds leave it out" * (validating and rollout.verdict.beyond)
    lines = [f"{named}{by}: {rollout.verdict.text}{aside}"] if light else []
    if rollout.diverged >= 0:
        lines.append(
            f"warning: {named} diverged at step {rollout.diverged} (off the grid or not finite); "
            "its errors are reported as ∞"
        )
    if rollout.needed_outside:
        lines.append(
            f"warning: {named}: a step needed {rollout.needed_outside} particles or nodes "
            "outside the superset or the grid; raise integration.margin or use integration=search"
        )
    return lines
