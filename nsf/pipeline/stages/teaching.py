"""The stage `teach` of `model=recurrence`: operators of the deployed step."""

import math
import time
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path

import numpy as np
import torch
from joblib.externals.loky import ProcessPoolExecutor, cpu_count
from omegaconf import OmegaConf

from nsf.data import Case, Trajectory
from nsf.data.schema import TRAJECTORY
from nsf.dynamics import ReducedBatch
from nsf.engines import Engine
from nsf.engines.operators import Course, Mirrored, Recorded, Taught, Teacher, Yardstick
from nsf.kinematics.manifold import Manifold
from nsf.progress import Progress
from nsf.runs import Record, Run
from nsf.scenes.symmetry import Image, Symmetry

#: File of a teach run with the operators.
OPERATORS = "operators.pt"
#: Particles that say how far a round's runs are off.
_LOOKED_AT = 1000
#: Shapes whose images are found together.
_SEEN_AT_ONCE = 200
#: Drawn runs of a process, at least: it takes seconds to start.
_LEAST_RUNS = 8


def teach(pipeline, run: Run) -> None:
    """Teach the operators of a pipeline's configuration; finished rounds in the run's folder are taken up.

    Args:
        pipeline: a `nsf.pipeline.Pipeline`.
        run: its teach run.
    """
    manifold, c = pipeline.manifold().to(pipeline.device), pipeline.config
    with run.record(device=pipeline.device, seed=c.seed, precision=c.precision) as record:
        _follow(pipeline, manifold, record)
    found, known = record.metrics, len(pipeline.split.train)
    steps = f"{found['teacher_steps']} steps of the teacher"
    asked = f"{known} full-order runs" if pipeline.of_runs else steps
    if drawn_cases := pipeline.of_runs and len(pipeline.lessons[1]):
        asked += f" and {drawn_cases} projected ones"
    # Full-order runs in cases that nothing was learned from are those of validation alone.
    back = not pipeline.of_runs or pipeline.split.validation
    where = "in cases held back" if back else "in the training cases, as there are no validation cases"
    beside = f", the projected step {100 * found['projected_error']:.2g} %" if pipeline.of_runs else ""
    pipeline.say(
        f"teach: {asked} in {found['teach_seconds']:.1f} s, "
        f"{100 * min(found['errors']):.2g} % off {where}{beside} → {run.id}"
    )


def _follow(pipeline, manifold: Manifold, record: Record) -> None:
    started = time.perf_counter()
    teaching, seed, device = pipeline.teaching, int(pipeline.config.seed), pipeline.device
    work = (1 + teaching.runs, "runs") if pipeline.of_runs else (teaching.steps, "teacher's steps")
    with Progress("teach", *work) as progress:
        truth = truth_of(pipeline, manifold)
        if pipeline.of_runs:
            images = teaching.symmetry.images(pipeline.scene) if teaching.symmetry else []
            lessons, yardstick = recorded(pipeline, manifold, truth)
            lessons += drawn(pipeline, manifold, lambda steps: progress.advance(steps / pipeline.scene.steps))
            if teaching.symmetry:
                seen = mirror(manifold, teaching.symmetry)
                lessons = [Mirrored(lesson, images, seen) for lesson in lessons]
            truth = None  # is the teacher
        else:
            lessons, yardstick = _asked(pipeline, manifold, progress)

        def told(line: str) -> None:
            progress.describe(line)
            if pipeline.of_runs:
                progress.advance(1)

        course = Course(lessons, truth, yardstick, teaching, seed, device, record.path, told, pipeline.say)
        before = time.perf_counter() - started
        operators, steps = course.follow(), course.steps
        broken = course.broken_affinity()
        last, beside = time.perf_counter(), {}
        if pipeline.of_runs:
            runs = yardstick.teacher.run()
            lost = any(yardstick.teacher.left_grid())
            beside["projected_error"] = math.inf if lost else yardstick.error(runs)
        spent = before + course.seconds + time.perf_counter() - last
    taught = Taught.of(lessons[0].setup, *course.gravity)
    operators.save(record.path / OPERATORS, taught, lessons[0].setup.samples)
    record.output(OPERATORS)
    for left in record.path.glob("round_*.pt"):
        left.unlink()
    record.metrics |= {
        "teach_seconds": spent,
        "teacher_steps": steps,
        "errors": course.errors,
        "broken_affinity": broken,
        "round": course.best,
    } | beside


def truth_of(pipeline, manifold: Manifold) -> torch.Tensor | None:
    """[N + 1, K, r] training latents, by ascending case; None where a step is not one of theirs."""
    if pipeline.config.deploy.dt_multiplier != 1.0:
        return None
    cases = pipeline.split.train
    order = sorted(range(len(cases)), key=cases.__getitem__)
    latents = manifold.training_latents.detach().to("cpu", torch.float64)
    return latents.unflatten(0, (len(cases), -1)).transpose(0, 1)[:, order]


def _asked(pipeline, manifold: Manifold, progress: Progress) -> tuple[list[Teacher], Yardstick]:
    """An engine's runs, and its own runs in cases that are held back.

    Not full-order runs there: where the teacher is off, a round could pass by straying towards them.
    """
    *cases, back = pipeline.lessons
    lessons = [Teacher(batches(pipeline, manifold, v), progress.advance) for v in cases if v]
    teacher, positions = Teacher(batches(pipeline, manifold, back), progress.advance), _positions(manifold)
    truth = torch.stack([positions(run) for run in teacher.run().unbind(1)], 1)
    return lessons, Yardstick(teacher, positions, truth)


def recorded(pipeline, manifold: Manifold, latents: torch.Tensor) -> tuple[list[Teacher], Yardstick]:
    """Full-order runs of training, whose latents [N + 1, K, r] are given, and those held back."""
    known, _, back = pipeline.lessons
    truth = []
    for case in back:
        with Trajectory.open(pipeline.simulation(case).require().file(TRAJECTORY)) as trajectory:
            truth.append(torch.as_tensor(trajectory.read("x", particles=_looked_at(manifold))).double())
    lessons = [Recorded(batches(pipeline, manifold, known), latents)]
    beside = Teacher(batches(pipeline, manifold, back))
    return lessons, Yardstick(beside, _positions(manifold), torch.stack(truth, 1))


def drawn(pipeline, manifold: Manifold, told: Callable[[float], object]) -> list[Teacher]:
    """Projected runs in the drawn cases between, those that are lost left out; of none, no teacher."""
    _, between, _ = pipeline.lessons
    if not between:
        return []
    taken = batches(pipeline, manifold, between)
    processes = min(cpu_count(), len(between) // _LEAST_RUNS)
    if processes > 1 and len(taken) == len(between) and taken[0].device.is_cpu:
        runs, left = _side_by_side(pipeline, between, processes, told)
    else:
        beside = Teacher(taken, told)
        runs, left = beside.run(), beside.left_grid()
    kept = torch.isfinite(runs).all(-1).all(0) & ~torch.tensor(left)
    cases = [case for case, good in zip(between, kept.tolist(), strict=True) if good]
    if len(cases) < len(between):
        pipeline.say(f"teach: warning: {len(between) - len(cases)} of {len(between)} projected runs are lost")
    if not cases:
        return []
    if len(cases) < len(between):
        taken = batches(pipeline, manifold, cases)
    found = Recorded(taken, runs[:, kept])
    found.steps = (len(runs) - 1) * len(between)
    return [found]


def _side_by_side(
    pipeline, cases: list[Case], processes: int, told: Callable[[float], object]
) -> tuple[torch.Tensor, list[bool]]:
    """x̂ [N + 1, R, r] of projected runs, and whether each left the grid; by several processes."""
    runs, left = [], []
    one = partial(_alone, type(pipeline), OmegaConf.to_yaml(pipeline.template), pipeline.root)
    with ProcessPoolExecutor(processes, initializer=torch.set_num_threads, initargs=(1,)) as pool:
        for run, gone in pool.map(one, cases):
            runs.append(run)
            left.append(gone)
            told(len(run) - 1)
    return torch.from_numpy(np.stack(runs, 1)), left


def _alone(kind: type, text: str, root: Path | None, case: Case) -> tuple[np.ndarray, bool]:
    """One run [N + 1, r] in a process of its own, and whether it left the grid."""
    pipeline, manifold = _opened(kind, text, root)
    teacher = Teacher(batches(pipeline, manifold, [case]))
    return teacher.run()[:, 0].numpy(), teacher.left_grid()[0]


@cache
def _opened(kind: type, text: str, root: Path | None) -> tuple:
    """The pipeline of a configuration and its manifold, once in a process."""
    pipeline = kind(OmegaConf.create(text), lambda line: None, root)
    return pipeline, pipeline.manifold().to(pipeline.device)


def mirror(manifold: Manifold, symmetry: Symmetry) -> Callable[[torch.Tensor, Image], torch.Tensor]:
    """(xhat [..., r], image) → the latent vectors whose shapes are nearest to the shapes' images."""
    X = manifold.X.cpu().numpy().astype(np.float64)

    def seen(xhat: torch.Tensor, image: Image) -> torch.Tensor:
        if np.array_equal(image.R, np.eye(3)):
            return xhat
        behind = manifold.restrict(X=symmetry.at(X, image.R.T), device=manifold.X.device)
        found = []
        with torch.no_grad():
            for part in xhat.flatten(0, -2).split(_SEEN_AT_ONCE):
                x = symmetry.at(behind.position(part.to(behind.device)).cpu().numpy(), image.R)
                found.append(manifold.encode(torch.as_tensor(x, device=behind.device)).cpu().double())
        return torch.cat(found).view(xhat.shape)

    return seen


def _looked_at(manifold: Manifold) -> np.ndarray:
    """Particles of the whole body: S may lie where little is like the rest, as beside a tear."""
    return np.sort(np.random.default_rng(0).permutation(len(manifold.X))[:_LOOKED_AT])


def _positions(manifold: Manifold) -> Callable[[torch.Tensor], torch.Tensor]:
    """xhat [N + 1, r] → positions [N + 1, s, 3] [m] of the particles that are looked at."""
    at = manifold.restrict(torch.as_tensor(_looked_at(manifold)), device=manifold.X.device)

    def positions(run: torch.Tensor) -> torch.Tensor:
        with torch.no_grad():
            return at.position(run.to(at.device)).cpu()

    return positions


def batches(
    pipeline, manifold: Manifold, cases: list[Case], engine: str | Engine | None = None
) -> list[ReducedBatch]:
    """Runs of the scene of training by an engine, the teacher's by default; one by one where it must be."""
    asked = {"engine": engine or pipeline.projecting, "scene": pipeline.scene}
    alone = pipeline.batch_at(manifold, cases[:1], engine=pipeline.projecting, scene=pipeline.scene)
    first = alone if engine is None else pipeline.batch_at(manifold, cases[:1], **asked)
    if alone.engine == "reference" or pipeline.integration.strategy == "search":
        return [first, *(pipeline.batch_at(manifold, [case], **asked) for case in cases[1:])]
    return [pipeline.batch_at(manifold, cases, **asked)]
