"""The stage `teach`: operators of the deployed step, taught by another engine."""

from collections.abc import Callable, Sequence
from pathlib import Path

import torch

from nsf.data import Trajectory
from nsf.data.schema import TRAJECTORY
from nsf.dynamics import ReducedBatch
from nsf.engines.operators import Course, Taught, Teacher, Yardstick, random_values
from nsf.kinematics.manifold import Manifold

#: File of a teach run with the operators.
OPERATORS = "operators.pt"
_HELD_BACK = 3  # values between the training ones whose runs decide which round is kept
#: Gives the runs at some values, of the scene of training, by the teacher's engine.
BatchesAt = Callable[[Sequence[float]], list[ReducedBatch]]


def course_of(
    pipeline,
    manifold: Manifold,
    batches_at: BatchesAt,
    folder: Path | None,
    told: Callable[[int], object],
) -> tuple[Course, Taught]:
    """A course of teaching for the configuration of a pipeline.

    Args:
        pipeline: a `nsf.pipeline.Pipeline`.
        manifold: its trained fields.
        batches_at: as above.
        folder: for rounds that are finished.
        told: called with each number of teacher's steps.

    Returns:
        The course, and what is taught on.
    """
    split, seed, teaching = pipeline.split, int(pipeline.config.seed), pipeline.teaching
    held_out = [*split.validation, *split.test]
    known = sorted(split.train)
    ranges = [(known[0], known[-1])]
    between = random_values(ranges, len(known), seed, [*held_out, *known])
    own, other = (Teacher(batches_at(values), told) for values in (known, between))
    yardstick = _yardstick(pipeline, manifold, batches_at, ranges, [*known, *between], told)
    truth = None
    if pipeline.config.deploy.dt_multiplier == 1.0:
        order = torch.as_tensor(sorted(range(len(known)), key=lambda i: split.train[i]))
        latents = manifold.training_latents.detach().cpu().double()
        truth = latents.unflatten(0, (len(known), -1)).transpose(0, 1)[:, order]
    course = Course([own, other], truth, yardstick, teaching, seed, folder, pipeline.say)
    first = batches_at(known[:1])[0].batch.shared
    middle = own.gravity.mean(0)
    reach = float((own.gravity - middle).norm(dim=1).max()) + course.reach
    return course, Taught.of(first, middle.tolist(), reach)


def _yardstick(pipeline, manifold, batches_at: BatchesAt, ranges, taken, told) -> Yardstick:
    """Validation runs where there are any, else the teacher's own between the training values."""
    split = pipeline.split
    validation = list(split.validation) if pipeline.config.deploy.dt_multiplier == 1.0 else []
    if validation:
        values = validation
    else:
        taken = [*taken, *split.validation, *split.test]
        values = random_values(ranges, _HELD_BACK, int(pipeline.config.seed) + 1, taken)
    teacher = Teacher(batches_at(values), told)
    span = batches_at(values[:1])[0].span_at(0)
    at = manifold.restrict(torch.as_tensor(span.sets.sample), device="cpu")

    def positions(run: torch.Tensor) -> torch.Tensor:
        with torch.no_grad():
            return at.position(run)

    if not validation:
        runs = teacher.run()
        return Yardstick(teacher, positions, torch.stack([positions(run) for run in runs.unbind(1)], 1))
    truths = []
    for value in validation:
        with Trajectory.open(pipeline.simulation(value).require().path / TRAJECTORY) as trajectory:
            x = trajectory.read("x", particles=span.sets.sample)
            truths.append(torch.as_tensor(x, dtype=torch.float64))
    return Yardstick(teacher, positions, torch.stack(truths, 1))
