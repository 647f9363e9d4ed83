"""Full-order runs in latent coordinates, of training and of drawn cases: what models learn from.

They are a run of their own, `encode`, which all models that learn from the same cases share. A run of a drawn
case is encoded as it is made, and not stored.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from itertools import chain
from pathlib import Path
from typing import NamedTuple

import numpy as np

from nsf.data import Case, Trajectory
from nsf.errors import InstabilityError
from nsf.kinematics.manifold import Manifold
from nsf.models.inputs import Lessons
from nsf.models.lookup import inputs_in
from nsf.pipeline.stages.cores import Advance, claimed, helper_count, helping
from nsf.progress import Progress
from nsf.recurrence.stream import (
    Encoded,
    Encoder,
    encoded_trajectory,
    modes_of_stress,
    streamed,
    stress_modes,
)
from nsf.runs import Record, Run
from nsf.scenes import Scene
from nsf.scenes.checks import host_bytes
from nsf.storage import intact

_MANIFOLD = "manifold.pt"


class Lesson(NamedTuple):
    """A case, and the scene in it, whose gravity may be another than the case has."""

    case: Case
    scene: Scene


def encode(pipeline, run: Run) -> None:
    """Encode the runs that the model of a pipeline learns from; those in the run's folder are taken up.

    Args:
        pipeline: a `nsf.pipeline.Pipeline`.
        run: its encode run.
    """
    manifold, c = pipeline.manifold().to(pipeline.device), pipeline.config
    with run.record(device=pipeline.device, seed=c.seed, precision=c.precision) as record:
        started = time.perf_counter()
        encoder = encoder_of(pipeline, manifold)
        files = _encoded(pipeline, encoder, lessons_of(pipeline), record)
        for file in files:
            record.output(file.name)
        runs = list(map(Encoded.open, files))
        record.metrics |= {
            "runs": len(runs),
            "streamed": sum(one.seconds > 0.0 for one in runs),
            "run_seconds": sum(one.seconds for one in runs),
            "stream_seconds": time.perf_counter() - started,
        }


def encoder_of(pipeline, manifold: Manifold) -> Encoder:
    """An encoder with all modes of stress, of which models take as many as they have.

    Raises:
        ConfigError: the model has more.
    """
    if stress := pipeline.model.stress_of(pipeline.forced):
        stress_modes(manifold, stress)
    return Encoder(manifold, modes_of_stress(manifold))


def lessons_of(pipeline) -> list[Lesson]:
    """The cases that the model of a pipeline learns from, each with its scene."""
    training, drawn, _ = pipeline.lessons
    return list(
        map(Lesson, [*training, *drawn], [*map(pipeline.scene.at, training), *_varied(pipeline, drawn)])
    )


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


def encoded_runs(pipeline, manifold: Manifold) -> Lessons:
    """The whole runs of a pipeline's encode run, with what determines them.

    Raises:
        MissingRunError: they are not there.
        SchemaError: a file was changed after its run.
        InstabilityError: none is whole.
    """
    run = pipeline.encoding.require()
    there = {output["path"] for output in run.manifest["outputs"]}
    pairs = [
        (lesson, Encoded.open(run.file(_file(index))))
        for index, lesson in enumerate(lessons_of(pipeline))
        if _file(index) in there
    ]
    whole = [(lesson, one) for lesson, one in pairs if one.finite]
    if not whole:
        raise InstabilityError(
            f"none of {len(pairs)} encoded runs is finite; set a smaller scene.dt, or a smaller latent_dim"
        )
    return joined(manifold, whole)


def encoded_validation(pipeline, manifold: Manifold) -> Lessons:
    """Likewise of the full-order runs by which a model is chosen, none of them held out."""
    encoder, pairs = encoder_of(pipeline, manifold), []
    for case in pipeline.lessons[2]:
        with Trajectory.of(pipeline.simulation(case).require()) as trajectory:
            run = encoded_trajectory(trajectory, encoder, pipeline.device) if trajectory.every == 1 else None
        if run is None:  # not every step is stored
            solver = pipeline.scene.full_order(case, pipeline.config.precision, pipeline.device)
            run = streamed(solver, pipeline.scene.steps, encoder)
        pairs.append((Lesson(case, pipeline.scene.at(case)), run))
    return joined(manifold, pairs)


def joined(manifold: Manifold, pairs: Sequence[tuple[Lesson, Encoded]]) -> Lessons:
    """Encoded runs, and what determines each of them."""
    cases, scenes = zip(*(lesson for lesson, _ in pairs), strict=True)
    xhat, stress = (np.stack([getattr(run, name) for _, run in pairs]) for name in ("xhat", "stress"))
    return Lessons(inputs_in(manifold, cases, scenes, xhat[:, 0]), xhat, stress)


def _file(index: int) -> str:
    return f"encoded_{index}.npz"


def _encoded(pipeline, encoder: Encoder, lessons: Sequence[Lesson], record: Record) -> list[Path]:
    """Files of the runs of some lessons, without those that are lost."""
    paths = [record.path / _file(index) for index in range(len(lessons))]
    steps, training = pipeline.scene.steps, pipeline.split.train
    each_step = pipeline.config.data.every == 1  # is stored
    with Progress("encode", len(lessons) * steps, "steps") as progress:
        missing = []
        for lesson, path in zip(lessons, paths, strict=True):
            stored = pipeline.simulation(lesson.case)
            if intact(path, pipeline.say):
                progress.advance(steps)
            elif each_step and lesson.case in training and stored.complete:
                with Trajectory.of(stored) as trajectory:
                    encoded_trajectory(trajectory, encoder, pipeline.device).save(path)
                progress.advance(steps)
            else:
                missing.append((lesson, path))
        lost = _stream(pipeline, encoder, missing, progress.advance)
    if lost:
        line = f"{len(lost)} of {len(lessons)} full-order runs are lost: {lost[0]}"
        record.warn([line])
        pipeline.say(f"teach: warning: {line}")
    return [path for path in paths if path.is_file()]


def _stream(pipeline, encoder: Encoder, missing, after: Callable[[int], object]) -> list[str]:
    """Make runs and write each one's file, side by side where there are cores; why some are lost."""
    how, device = (pipeline.config.precision, pipeline.device), pipeline.device
    share = partial(_share, missing, how)
    help_with = partial(_help, share, pipeline.training.file(_MANIFOLD), encoder.stress)
    size = host_bytes(pipeline.scene, pipeline.config.precision)
    count = helper_count(device, [lesson.scene for lesson, _ in missing], size)
    with helping(help_with, count, after) as helpers:

        def advance(steps: int) -> None:
            after(steps)
            helpers.look()

        ends = [*share(encoder, advance, helpers.folder), *chain.from_iterable(helpers.results())]
    return [end for end in ends if end]


def _help(
    share: Callable, trained: Path, stress: int, number: int, advance: Advance, folder: Path
) -> list[str]:
    """Share the runs in another process."""
    return share(Encoder(Manifold.load(trained), stress), advance, folder)


def _share(missing, how: tuple[str, str], encoder: Encoder, advance: Advance, folder: Path) -> list[str]:
    """Make the runs that no other process makes; why some are lost, empty texts for helpers."""
    return [
        _run(encoder, how, *pair, lambda: advance(1))
        for index, pair in enumerate(missing)
        if claimed(folder, index)
    ]


def _run(encoder: Encoder, how: tuple[str, str], lesson: Lesson, path: Path, after=lambda: None) -> str:
    """Make one run and write its file; why it is lost, empty where it is not."""
    try:
        solver = lesson.scene.full_order({}, *how)
        streamed(solver, lesson.scene.steps, encoder, after).save(path)
    except InstabilityError as error:
        return f"{lesson.case.named}: {error}"
    return ""
