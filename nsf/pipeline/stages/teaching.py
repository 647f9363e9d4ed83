"""The stage `teach`: operators of the deployed step, taught by another engine."""

import time

import numpy as np
import torch

from nsf.data import Case
from nsf.dynamics import ReducedBatch
from nsf.engines.operators import Course, Taught, Teacher, Yardstick
from nsf.kinematics.manifold import Manifold
from nsf.progress import Progress
from nsf.runs import Record, Run

#: File of a teach run with the operators.
OPERATORS = "operators.pt"
#: Particles that say how far a round's runs are off.
_LOOKED_AT = 1000


def teach(pipeline, run: Run) -> None:
    """Teach the operators of a pipeline's configuration; finished rounds in the run's folder are taken up.

    Args:
        pipeline: a `nsf.pipeline.Pipeline`.
        run: its teach run.
    """
    manifold, c = pipeline.manifold().to(pipeline.device), pipeline.config
    with run.record(device=pipeline.device, seed=c.seed, precision=c.precision) as record:
        _follow(pipeline, manifold, record)
    found = record.metrics
    pipeline.say(
        f"teach: {found['teacher_steps']} steps of the teacher in {found['teach_seconds']:.1f} s, "
        f"{100 * min(found['errors']):.2g} % off in cases held back → {run.id}"
    )


def _follow(pipeline, manifold: Manifold, record: Record) -> None:
    started = time.perf_counter()
    with Progress("teach", pipeline.teaching.steps, "teacher's steps") as progress:
        known, between, _ = pipeline.lessons
        lessons = [Teacher(_batches(pipeline, manifold, v), progress.advance) for v in (known, between) if v]
        yardstick = _yardstick(pipeline, manifold, progress)
        seed = int(pipeline.config.seed)
        truth, device = _truth(pipeline, manifold), pipeline.device
        course = Course(
            lessons, truth, yardstick, pipeline.teaching, seed, device, record.path, progress.describe
        )
        before = time.perf_counter() - started
        operators, steps = course.follow(), course.steps
        broken = course.broken_affinity()
    taught = Taught.of(lessons[0].setup, *course.gravity)
    operators.save(record.path / OPERATORS, taught)
    record.output(OPERATORS)
    for left in record.path.glob("round_*.pt"):
        left.unlink()
    record.metrics |= {
        "teach_seconds": before + course.seconds,
        "teacher_steps": steps,
        "errors": course.errors,
        "broken_affinity": broken,
        "round": course.best,
    }


def _truth(pipeline, manifold: Manifold) -> torch.Tensor | None:
    """[N + 1, K, r] training latents, by ascending case; None where a step is not one of theirs."""
    if pipeline.config.deploy.dt_multiplier != 1.0:
        return None
    cases = pipeline.split.train
    order = sorted(range(len(cases)), key=cases.__getitem__)
    latents = manifold.training_latents.detach().to("cpu", torch.float64)
    return latents.unflatten(0, (len(cases), -1)).transpose(0, 1)[:, order]


def _yardstick(pipeline, manifold: Manifold, progress: Progress) -> Yardstick:
    """The teacher's own runs in cases that are held back.

    Not full-order runs: where the teacher is off, a round could pass by straying towards them by chance.
    """
    teacher = Teacher(_batches(pipeline, manifold, pipeline.lessons[2]), progress.advance)
    # S may lie where little is like the rest, as beside a tear: these are of the whole body.
    looked_at = np.sort(np.random.default_rng(0).permutation(len(manifold.X))[:_LOOKED_AT])
    at = manifold.restrict(torch.as_tensor(looked_at), device=manifold.X.device)

    def positions(run: torch.Tensor) -> torch.Tensor:
        with torch.no_grad():
            return at.position(run.to(at.device)).cpu()

    return Yardstick(teacher, positions, torch.stack([positions(run) for run in teacher.run().unbind(1)], 1))


def _batches(pipeline, manifold: Manifold, cases: list[Case]) -> list[ReducedBatch]:
    """Runs of the scene of training by the teacher's engine; one by one where it steps them so."""
    asked = {"engine": pipeline.projecting, "scene": pipeline.scene}
    first = pipeline.batch_at(manifold, cases[:1], **asked)
    if first.engine == "reference" or pipeline.integration.strategy == "search":
        return [first, *(pipeline.batch_at(manifold, [case], **asked) for case in cases[1:])]
    return [pipeline.batch_at(manifold, cases, **asked)]
