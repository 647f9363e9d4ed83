"""The stage `teach` of `engine=closed`: what the projected step lacks of the full-order runs of training."""

import math
import time

import torch

from nsf.engines import Closed
from nsf.engines.closed import Fit, Linearised
from nsf.engines.operators import Taught, Teacher, Yardstick
from nsf.engines.operators.teach import standardised
from nsf.errors import InstabilityError
from nsf.kinematics.manifold import Manifold
from nsf.pipeline.stages.teaching import OPERATORS, batches, recorded, truth_of
from nsf.progress import Progress
from nsf.runs import Record, Run


def close(pipeline, run: Run) -> None:
    """Fit the closure of a pipeline's configuration.

    Args:
        pipeline: a `nsf.pipeline.Pipeline`.
        run: its teach run.

    Raises:
        InstabilityError: the fit, or a run with it, did not stay finite, or most projected steps did not.
    """
    manifold, c = pipeline.manifold().to(pipeline.device), pipeline.config
    with run.record(device=pipeline.device, seed=c.seed, precision=c.precision) as record:
        _follow(pipeline, manifold, record)
    found = record.metrics
    before, after = (100.0 * error for error in found["errors"])
    where = "validation" if pipeline.split.validation else "training"
    if after >= before:
        pipeline.say("teach: warning: the closure makes no run better; deploy with engine=auto")
    if found["lost"]:
        pipeline.say(
            f"teach: warning: {100 * found['lost']:.2g} % of what was asked of the step was not finite"
        )
    pipeline.say(
        f"teach: a closure by {found['teacher_steps']} projected steps in {found['teach_seconds']:.1f} s; in "
        f"{where} cases {after:.2g} % off, {before:.2g} % without it → {run.id}"
    )


def _follow(pipeline, manifold: Manifold, record: Record) -> None:
    started, closing, seed = time.perf_counter(), pipeline.closing, int(pipeline.config.seed)
    runs = truth_of(pipeline, manifold)
    _, yardstick = recorded(pipeline, manifold, runs)
    N, R, r = runs.shape[0] - 1, runs.shape[1], runs.shape[2]
    asked = N + 4 * r * -(-N // closing.stride)
    with Progress("teach", asked * R, "projected steps") as progress:
        teacher = Teacher(batches(pipeline, manifold, sorted(pipeline.split.train)), progress.advance)
        linearised = Linearised.along(teacher, runs, closing.stride)
    gravity, changes = bool(teacher.gravity.any()), torch.diff(runs, dim=0)
    model = standardised(
        teacher, runs, changes, linearised.defect, closing.width, gravity, seed, closing.memory
    )
    model = model.to(pipeline.device, torch.float32)
    with Progress("teach", closing.turns, "steps of the fit") as progress:
        generator = torch.Generator().manual_seed(seed)
        Fit(model, teacher, linearised, closing, generator).run(progress.advance)
    model = model.to("cpu", torch.float64).requires_grad_(False).eval()
    taught, samples = Taught.of(teacher.setup, *teacher.known_gravity), teacher.setup.samples
    seconds, engine = time.perf_counter() - started, Closed(model, taught, samples)
    errors = [_off(pipeline, manifold, yardstick, by) for by in (pipeline.projecting, engine)]
    if linearised.lost > 0.5 or not math.isfinite(errors[1]):
        raise InstabilityError(
            "runs with the closure do not stay finite; lower engine.closing.rate or engine.closing.unroll, "
            "or deploy with engine=auto"
        )
    model.save(record.path / OPERATORS, taught, samples, Closed.name)
    record.output(OPERATORS)
    record.metrics |= {
        "teach_seconds": seconds, "teacher_steps": teacher.steps, "errors": errors, "lost": linearised.lost,
    }  # fmt: skip


def _off(pipeline, manifold: Manifold, yardstick: Yardstick, engine) -> float:
    """Mean displacement error of runs in the cases of a yardstick, a fraction."""
    batch = batches(pipeline, manifold, pipeline.lessons[2], engine)
    return yardstick.error(Teacher(batch).run())
