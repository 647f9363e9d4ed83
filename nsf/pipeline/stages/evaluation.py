"""The stages `evaluate` and `superresolve`: reduced runs held to full-order ones, and their costs."""

import contextlib
import math
from collections.abc import Sequence
from pathlib import Path

from nsf.data import Trajectory
from nsf.data.schema import TRAJECTORY
from nsf.deployment import FULL_ORDER, PROJECTED, TRUST, Rollout, Trust, continuation_file
from nsf.dynamics.setup import reduced_steps
from nsf.errors import SchemaError
from nsf.evaluation import (
    Comparison,
    Rivals,
    SolverCost,
    Subject,
    coarse_subjects,
    compare,
    decoding_ms,
    measure,
    rivals,
    superresolve,
)
from nsf.kinematics.manifold import Manifold
from nsf.pipeline.stages import results
from nsf.pipeline.stages.calibration import beyond, rollouts_of
from nsf.progress import Progress
from nsf.runs import Run
from nsf.vectors import spaced

#: Figures of `superresolve` in words; means over the held-out cases.
_EXPLAINED = {
    "delta": "δ of the fields at all points, beside a full-order run of as many particles",
    "particles_delta": "δ at the training particles, which are among the points",
    "displacement_error": "displacement error at all points",
    "interpolation_error": "displacement error where the fine run's own particles are interpolated instead",
    "full_order_difference": "displacement between the two full-order runs: what no field can know",
    "smeared": "of these lie more than half a cell from where the fine run has them",
}


def evaluate(pipeline, run: Run) -> None:
    """Write the errors and costs of a pipeline's reduced runs.

    Args:
        pipeline: a `nsf.pipeline.Pipeline`.
        run: its evaluate run.
    """
    truths, manifold = _truths(pipeline), pipeline.manifold().to(pipeline.device)  # as in deployment
    with run.record(device=pipeline.device, precision=pipeline.config.precision) as record:
        rollouts = rollouts_of(pipeline, manifold)
        frames, coarse = pipeline.deployed.steps // pipeline.config.data.every + 1, len(pipeline.coarse)
        total = len(rollouts) * ((2 + coarse) * frames - 1)  # rivals are not compared in the first
        with Progress("evaluate", total, "frames") as progress:
            pairs = [
                _compare(pipeline, manifold, rollout, truth, index, progress)
                for index, (rollout, truth) in enumerate(zip(rollouts, truths, strict=True))
            ]
        comparisons, beside = zip(*pairs, strict=True)
        measured, decode_ms = _measured(pipeline, manifold, rollouts, beside[0].factors)
        table = results.rows(pipeline, manifold, rollouts, comparisons, beside, measured, decode_ms)
        table["ready_seconds"] = _ready(pipeline.deployment) if measured else math.nan
        table["beyond"] = _beyond(pipeline, manifold, rollouts, comparisons)
        summary = results.summarise(pipeline.config, comparisons, beside, rollouts)
        results.write(record, table, comparisons, results.costs(measured, decode_ms), summary)
        if (error := pipeline.deployment.manifest["metrics"].get("validation_error")) is not None:
            record.metrics["validation_error"] = error
    pipeline.say(f"evaluate: mean δ {100 * table['delta'].mean():.3g} % over {len(table)} cases → {run.id}")


def superresolve_held_out(pipeline, run: Run) -> None:
    """Write a pipeline's reduced runs at many more points, beside full-order ones of as many particles.

    Args:
        pipeline: a `nsf.pipeline.Pipeline`.
        run: its superresolve run.
    """
    c, keys, steps = pipeline.config, pipeline.config.super_resolution, pipeline.scene.steps
    truths, manifold = _truths(pipeline), pipeline.manifold()
    # Evenly spread, without frame 0, at which nothing has moved.
    frames = spaced(steps // c.data.every + 1, keys.frames + 1)[1:]
    with run.record(device=pipeline.device, precision=c.precision) as record:
        rollouts = rollouts_of(pipeline, manifold)
        with contextlib.ExitStack() as files:
            fine = superresolve(
                manifold,
                pipeline.deployed,
                [files.enter_context(Trajectory.open(truth)) for truth in truths],
                rollouts,
                keys.factor,
                frames.tolist(),
                keys.substeps,
                c.precision,
                pipeline.device,
                pipeline.say,
            )
        table = results.write_superresolution(record, pipeline.deployed, pipeline.held_out, fine)
    mean = {name: f"{100 * table[name].mean():.3g} %" for name in _EXPLAINED}
    pipeline.say(
        f"superresolve: {table['points'][0]:,} points, mean δ {mean['delta']} "
        f"({mean['particles_delta']} at the {len(manifold.X):,} particles), "
        f"queried in {table['seconds'].sum():.1f} s → {run.id}"
    )
    for name, meaning in _EXPLAINED.items():
        pipeline.say(f"superresolve: {mean[name]:>8} {meaning}")
    pipeline.say(f"superresolve: open {(run.path / 'superresolution.png').resolve()}")


def _truths(pipeline) -> list[Path]:
    """Files of the full-order trajectories that the deployed ones are held to."""
    return [pipeline.truth(case).file(TRAJECTORY) for case in pipeline.held_out]


def _beyond(pipeline, manifold: Manifold, rollouts, comparisons: Sequence[Comparison]) -> list[int]:
    """Of each held-out case, 1 where it leads beyond what was taught, else 0."""
    trust = Trust.open(pipeline.deployment.file(TRUST), manifold)
    names = [f"encoded_{k + 1}" for k in range(manifold.latent_dim)]
    return [
        int(beyond(pipeline, trust, rollout.case, comparison.series[names].to_numpy()))
        for rollout, comparison in zip(rollouts, comparisons, strict=True)
    ]


def _ready(deployment: Run) -> float:
    """Time from the command to the first step of a deployed run [s]; NaN of full-order runs."""
    with contextlib.suppress(SchemaError):
        return deployment.metric("ready_seconds")
    return math.nan


def _took(pipeline, rollout: Rollout) -> str | None:
    """The engine of a run that the projected model took in place of another; None: as configured."""
    return pipeline.projecting if rollout.by == PROJECTED else None


def _compare(
    pipeline, manifold: Manifold, rollout: Rollout, truth: Path, index: int, progress: Progress
) -> tuple[Comparison, Rivals]:
    keys = pipeline.config.evaluation
    progress.describe(rollout.case.named)
    with contextlib.ExitStack() as files:
        trajectory = files.enter_context(Trajectory.open(truth))
        rest = None
        if rollout.by == FULL_ORDER:
            rest = files.enter_context(Trajectory.open(pipeline.deployment.file(continuation_file(index))))
        solver = pipeline.solver_at(manifold, rollout.case, engine=_took(pipeline, rollout))
        shown = (keys.picture_particles, keys.picture_frames)
        split = pipeline.config.deploy.split
        comparison = compare(solver, trajectory, rollout, split, shown, rest, progress.advance)
        forced = pipeline.split.train if pipeline.scene.forcing else ()
        training = list(map(pipeline.scene.at, forced))
        return comparison, rivals(solver, trajectory, pipeline.coarse, training, progress.advance)


def _measured(
    pipeline, manifold: Manifold, rollouts: Sequence[Rollout], factors: Sequence[int]
) -> tuple[dict[str, SolverCost], float]:
    """Costs of the solvers in the first held-out case, and of decoding [ms]; nothing without trials.

    Args:
        pipeline, manifold: that are timed.
        rollouts: the reduced runs; that of the first case is decoded. Where the projected model took
            runs of another, its steps are timed as well.
        factors: of Δx of the coarse full-order runs that there are.
    """
    c, scene, case = pipeline.config, pipeline.deployed, pipeline.held_out[0]
    if not c.evaluation.trials:
        return {}, math.nan
    full = Subject(lambda: scene.full_order(case, c.precision, pipeline.device), scene.steps)
    steps = reduced_steps(scene.steps, c.deploy.dt_multiplier)
    reduced = Subject(lambda: pipeline.solver_at(manifold, case), steps)
    beside = {}
    if any(rollout.by == PROJECTED for rollout in rollouts):
        engine = pipeline.projecting
        beside[PROJECTED] = Subject(lambda: pipeline.solver_at(manifold, case, engine=engine), steps)
    coarse = coarse_subjects(scene, case, factors, c.precision, pipeline.device)
    subjects = {"full_order": full, "reduced": reduced, **beside, **coarse}
    with Progress("evaluate: timings", len(subjects) * (c.evaluation.trials + 1), "runs") as progress:
        measured = measure(subjects, c.evaluation.trials, pipeline.device, progress.advance)
    return measured, decoding_ms(pipeline.solver_at(manifold, case), rollouts[0], c.evaluation.trials)
