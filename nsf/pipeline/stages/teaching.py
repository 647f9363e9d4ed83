"""The stage `teach` of `model=recurrence`: full-order runs, encoded as they are made, and a fit."""

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from joblib.externals.loky import ProcessPoolExecutor, cpu_count

from nsf.data import Case, Trajectory
from nsf.data.schema import TRAJECTORY
from nsf.errors import ConfigError, InstabilityError
from nsf.kinematics.manifold import Manifold
from nsf.progress import Progress
from nsf.recurrence import taught as files
from nsf.recurrence.descent import Runs, Yardstick, fit, standardised
from nsf.recurrence.engine import first_change
from nsf.recurrence.solids import collider_states
from nsf.recurrence.stream import Encoded, Encoder, encoded_trajectory, streamed
from nsf.recurrence.taught import Taught
from nsf.runs import Record, Run
from nsf.scenes import Scene
from nsf.scenes.identity import physics_hash
from nsf.storage import intact

#: File of a teach run with the recurrence.
RECURRENCE = "recurrence.pt"
_MANIFOLD = "manifold.pt"
#: Particles, and frames at most, at which validation runs are compared.
_PARTICLES, _FRAMES = 500, 50
#: Runs of a process, at least: it takes seconds to start.
_LEAST_RUNS = 8


def teach(pipeline, run: Run) -> None:
    """Teach the recurrence of a pipeline's configuration; encoded runs in the run's folder are taken up.

    Args:
        pipeline: a `nsf.pipeline.Pipeline`.
        run: its teach run.
    """
    manifold, c = pipeline.manifold().to(pipeline.device), pipeline.config
    with run.record(device=pipeline.device, seed=c.seed, precision=c.precision) as record:
        _teach(pipeline, manifold, record)
        metrics = record.metrics
    held_back = "validation" if pipeline.split.validation else "the training cases, as no others are there"
    pipeline.say(
        f"teach: {metrics['runs']} full-order runs, {metrics['streamed']} of them streamed, in "
        f"{metrics['stream_seconds']:.1f} s, fitted in {metrics['fit_seconds']:.1f} s, "
        f"{100 * min(metrics['errors']):.2g} % off at {held_back} → {run.id}"
    )


def _teach(pipeline, manifold: Manifold, record: Record) -> None:
    model, device = pipeline.model, pipeline.device
    started = time.perf_counter()
    training, drawn, validation = pipeline.lessons
    encoder = Encoder(manifold, model.stress_of(pipeline.forced))
    scenes = [*map(pipeline.scene.at, training), *_varied(pipeline, drawn)]
    lessons = list(map(Lesson, [*training, *drawn], scenes))
    lessons, encoded = _encoded(pipeline, encoder, lessons, record)
    fitted = time.perf_counter()
    runs = _runs(pipeline, manifold, lessons, encoded)
    yardstick = _yardstick(pipeline, manifold, encoder, validation)
    seed, stride = int(pipeline.config.seed), model.stride_of(pipeline.scene.steps)
    form = standardised(runs, model.fitting, pipeline.scene.dt, stride, pipeline.forced, seed)
    sigma = _moves(yardstick, form.x_mean, form.x_scale)
    with Progress("teach: fit", model.descents, "descents") as progress:
        errors = fit(form, runs, yardstick, sigma, model.fitting, seed, device, progress.advance)
    gravity = runs.gravity.flatten(0, 1).numpy()
    taught = Taught.of(manifold, physics_hash(pipeline.scene), pipeline.scene.dt, gravity)
    files.save(form, taught, record.path / RECURRENCE)
    record.output(RECURRENCE)
    for path in record.path.glob("encoded_*.npz"):
        path.unlink()
    record.metrics |= {
        "errors": errors,
        "runs": len(lessons),
        "streamed": sum(run.seconds > 0.0 for run in encoded),
        "run_seconds": sum(run.seconds for run in encoded),
        "stream_seconds": fitted - started,
        "fit_seconds": time.perf_counter() - fitted,
        "teach_seconds": time.perf_counter() - started,
    }


# -- runs ---------------------------------------------------------------------------------------------------


class Lesson(NamedTuple):
    """A case, and the scene in it, whose gravity may be another than the case has."""

    case: Case
    scene: Scene


def _varied(pipeline, cases: Sequence[Case]) -> list[Scene]:
    """The scene in drawn cases; where no program forces it, gravity is varied in a ball about its own."""
    scenes = [pipeline.scene.at(case) for case in cases]
    if pipeline.scene.forcing.gravity:
        return scenes
    generator = np.random.default_rng(pipeline.config.seed)
    ways = generator.standard_normal((len(cases), 3))
    ways *= generator.random((len(cases), 1)) ** (1 / 3) / np.linalg.norm(ways, axis=1, keepdims=True)
    reach = pipeline.model.gravity * float(np.linalg.norm(pipeline.scene.gravity))
    varied = zip(scenes, reach * ways, strict=True)
    return [replace(scene, gravity=tuple((scene.gravity + way).tolist())) for scene, way in varied]


def _encoded(
    pipeline, encoder: Encoder, lessons: Sequence[Lesson], record: Record
) -> tuple[list[Lesson], list[Encoded]]:
    """Full-order runs of some lessons, those that are lost left out; each is a file until all are there."""
    paths = [record.path / f"encoded_{index}.npz" for index in range(len(lessons))]
    steps, training = pipeline.scene.steps, pipeline.split.train
    with Progress("teach: full-order runs", len(lessons) * steps, "steps") as progress:
        missing = []
        for lesson, path in zip(lessons, paths, strict=True):
            stored = pipeline.simulation(lesson.case)
            if intact(path, pipeline.say):
                progress.advance(steps)
            elif lesson.case in training and stored.complete:
                with Trajectory.open(stored.file(TRAJECTORY)) as trajectory:
                    encoded_trajectory(trajectory, encoder, pipeline.device).save(path)
                progress.advance(steps)
            else:
                missing.append((lesson, path))
        lost = _stream(pipeline, encoder, missing, progress.advance)
    if lost:
        pipeline.say(f"teach: warning: {len(lost)} of {len(lessons)} full-order runs are lost: {lost[0]}")
    pairs = [
        (lesson, Encoded.open(path)) for lesson, path in zip(lessons, paths, strict=True) if path.is_file()
    ]
    pairs = [(lesson, run) for lesson, run in pairs if run.finite]
    if len(pairs) < encoder.stress:
        raise ConfigError(
            f"model.stress={encoder.stress} coordinates need as many runs, and {len(pairs)} are whole; set "
            f"model.stress={len(pairs)} or fewer"
        )
    return [lesson for lesson, _ in pairs], [run for _, run in pairs]


def _stream(pipeline, encoder: Encoder, missing, after: Callable[[int], object]) -> list[str]:
    """Make runs and write each one's file, side by side where there are cores; why some are lost."""
    how = pipeline.config.precision, pipeline.device
    processes = min(cpu_count(), len(missing) // _LEAST_RUNS)
    if processes > 1 and pipeline.device == "cpu":
        trained = pipeline.training.file(_MANIFOLD)
        with ProcessPoolExecutor(processes, initializer=torch.set_num_threads, initargs=(1,)) as pool:
            ends = []
            for end in pool.map(partial(_alone, trained, encoder.stress, how), *zip(*missing, strict=True)):
                ends.append(end)
                after(pipeline.scene.steps)
    else:
        ends = [_run(encoder, how, *pair, lambda: after(1)) for pair in missing]
    return [end for end in ends if end]


def _run(encoder: Encoder, how: tuple[str, str], lesson: Lesson, path: Path, after=lambda: None) -> str:
    """Make one run and write its file; why it is lost, empty where it is not."""
    try:
        solver = lesson.scene.full_order({}, *how)
        streamed(solver, lesson.scene.steps, encoder, after).save(path)
    except InstabilityError as error:
        return f"{lesson.case.named}: {error}"
    return ""


def _alone(trained: Path, stress: int, how: tuple[str, str], lesson: Lesson, path: Path) -> str:
    """Make one run in another process, which reads the manifold's file; why it is lost, or nothing."""
    return _run(_encoder(trained, stress), how, lesson, path)


@cache
def _encoder(trained: Path, stress: int) -> Encoder:
    """The encoder of a manifold's file, once in a process."""
    return Encoder(Manifold.load(trained), stress)


def _runs(pipeline, manifold: Manifold, lessons: Sequence[Lesson], encoded: Sequence[Encoded]) -> Runs:
    """Encoded runs, and what determines each of them."""
    cases, scenes = zip(*lessons, strict=True)
    dt, steps = pipeline.scene.dt, pipeline.scene.steps
    t = dt * np.arange(steps)
    first = [first_change(manifold, s.particles().X, s.initial_velocity(), dt) for s in scenes]
    parameters = np.array([[case[name] for name in manifold.parameter_names] for case in cases])
    stacked = (
        np.stack([run.xhat for run in encoded], 1),
        np.stack([run.stress for run in encoded], 1),
        torch.stack(first),
        parameters.reshape(len(cases), -1),
        np.stack([scene.acting_gravity.at(t) for scene in scenes], 1),
        np.stack([collider_states(scene.solids, dt, steps) for scene in scenes], 1),
    )
    return Runs.in_strides(
        pipeline.model.stride_of(pipeline.scene.steps),
        *(torch.as_tensor(values).double() for values in stacked),
    )


# -- validation ---------------------------------------------------------------------------------------------


def _yardstick(pipeline, manifold: Manifold, encoder: Encoder, cases: Sequence[Case]) -> Yardstick:
    """The full-order runs that choose the weights, none of them held out."""
    particles = np.sort(np.random.default_rng(0).permutation(len(manifold.X))[:_PARTICLES])
    strides = pipeline.scene.steps // pipeline.model.stride_of(pipeline.scene.steps)
    every = max(1, strides // _FRAMES)
    encoded, truth = [], []
    for case in cases:
        with Trajectory.open(pipeline.simulation(case).require().file(TRAJECTORY)) as trajectory:
            encoded.append(encoded_trajectory(trajectory, encoder, pipeline.device))
            frames = range(0, trajectory.frames, every * pipeline.model.stride_of(pipeline.scene.steps))
            truth.append(torch.as_tensor(trajectory.read("x", frames=list(frames), particles=particles)))
    at = manifold.restrict(torch.as_tensor(particles), device=manifold.X.device)

    def positions(xhat: torch.Tensor) -> torch.Tensor:
        with torch.no_grad():
            return at.position(xhat.to(at.device)).double().cpu()

    lessons = [Lesson(case, pipeline.scene.at(case)) for case in cases]
    runs = _runs(pipeline, manifold, lessons, encoded)
    return Yardstick(runs, positions, torch.stack(truth, 1).double(), every)


def _moves(yardstick: Yardstick, xhat: torch.Tensor, scale: torch.Tensor) -> torch.Tensor:
    """[r] how far particles move with each coordinate, RMS [m] a unit of it; at x̂ [r], by ± scale [r]."""
    either = [yardstick.positions(xhat + way * torch.diag(scale)) for way in (1.0, -1.0)]
    moved = (either[0] - either[1]).square().sum(-1).mean(1).sqrt() / (2.0 * scale)
    return moved.clamp_min(max(1e-3 * float(moved.max()), torch.finfo(moved.dtype).tiny))
