"""The stage `teach`: a model of latent vectors is fitted to encoded full-order runs."""

import math
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch

from nsf.data import Trajectory, archives
from nsf.errors import ConfigError
from nsf.kinematics.manifold import Manifold
from nsf.models import Recurrence
from nsf.models.inputs import Lessons, Validation
from nsf.models.lookup import training_lessons
from nsf.pipeline.stages.encoding import encoded_runs, encoded_validation
from nsf.progress import Progress
from nsf.recurrence import taught as files
from nsf.recurrence.descent import Runs, Yardstick, fit
from nsf.recurrence.scales import standardised
from nsf.recurrence.taught import Taught
from nsf.runs import Record, Run
from nsf.scenes.identity import physics_hash
from nsf.storage import writing

#: File of a teach run: of a recurrence, and of any other model.
RECURRENCE, FITTED = "recurrence.pt", "model.pt"
_FRAMES = 50  # at most, at which validation runs are compared


def teach(pipeline, run: Run) -> None:
    """Fit the model of a pipeline's configuration to its encoded runs.

    Args:
        pipeline: a `nsf.pipeline.Pipeline`, whose encode run is there.
        run: its teach run.
    """
    manifold, c = pipeline.manifold().to(pipeline.device), pipeline.config
    with run.record(device=pipeline.device, seed=c.seed, precision=c.precision) as record:
        started, encoding = time.perf_counter(), pipeline.encoding
        lessons = encoded_runs(pipeline, manifold)
        validation = encoded_validation(pipeline, manifold)
        fit_of = _recurrence if isinstance(pipeline.model, Recurrence) else _latents
        errors = fit_of(pipeline, manifold, lessons, validation, record)
        seconds = time.perf_counter() - started
        record.metrics |= {
            "errors": errors,
            "runs": len(lessons.xhat),
            **{name: encoding.metric(name) for name in ("streamed", "run_seconds", "stream_seconds")},
            "fit_seconds": seconds,
            "teach_seconds": encoding.metric("stream_seconds") + seconds,
        }
    _say(pipeline, record.metrics, run)


def _say(pipeline, metrics: dict, run: Run) -> None:
    held_back = "validation" if pipeline.split.validation else "the training cases, as no others are there"
    pipeline.say(
        f"teach: model={pipeline.model.name}, {metrics['runs']} full-order runs, {metrics['streamed']} "
        f"drawn in {metrics['stream_seconds']:.1f} s, fitted in {metrics['fit_seconds']:.1f} s, "
        f"{100 * min(metrics['errors']):.2g} % off at {held_back} → {run.id}"
    )


def _recurrence(
    pipeline, manifold: Manifold, lessons: Lessons, validation: Lessons, record: Record
) -> list[float]:
    """Fit a recurrence and write its file; its mean displacement errors at the validation runs."""
    model, scene = pipeline.model, pipeline.scene
    stride, stress = model.stride_of(scene.steps), model.stress_of(pipeline.forced)
    if len(lessons.xhat) < stress:
        raise ConfigError(
            f"model.stress={stress} coordinates need as many runs, and {len(lessons.xhat)} are whole; set "
            f"model.stress={len(lessons.xhat)} or fewer"
        )
    runs, seed = Runs.of(lessons, stride, stress), int(pipeline.config.seed)
    yardstick = _yardstick(pipeline, manifold, validation)
    fitting = model.fitting_of(pipeline.forced)
    form = standardised(runs, fitting, scene.dt, stride, pipeline.forced, seed)
    sigma = yardstick.moves(form.x_mean, form.x_scale)
    with Progress("teach: fit", model.descents, "descents") as progress:
        how = sigma, fitting, seed, pipeline.device, progress.advance
        errors = fit(form, runs, yardstick, *how)
    gravity = lessons.inputs.gravity.reshape(-1, 3)
    taught = Taught.of(manifold, physics_hash(scene), scene.dt, gravity)
    files.save(form, taught, record.path / RECURRENCE)
    record.output(RECURRENCE)
    return errors


def _latents(
    pipeline, manifold: Manifold, lessons: Lessons, validation: Lessons, record: Record
) -> list[float]:
    """Fit another model of latent vectors and write its file; likewise."""
    model, of = pipeline.model, validation.inputs
    yardstick = _yardstick(pipeline, manifold, validation)
    xhat = torch.as_tensor(lessons.xhat).double().flatten(0, 1)
    moves = yardstick.moves(xhat.mean(0), xhat.std(0).clamp_min(1e-9)).numpy()

    def error(rows: np.ndarray) -> float:
        nodes = torch.as_tensor(np.asarray(rows)).double().transpose(0, 1)[:: yardstick.stride]
        return float(yardstick.off(nodes).mean())

    fitted = model.fit(manifold, lessons, Validation(of, error, moves), int(pipeline.config.seed))
    with writing(record.path / FITTED) as partial:
        torch.save(fitted, partial)
    record.output(FITTED)
    return [error(model.run(loaded_file(record.path / FITTED), of))]


def fitted(pipeline, manifold: Manifold) -> Any:
    """The fit of a model that learns nothing beforehand, to the training runs."""
    lessons = training_lessons(manifold, pipeline.scene, pipeline.split.train)
    return pipeline.model.fit(manifold, lessons, None, int(pipeline.config.seed))


def loaded(run: Run) -> Any:
    """The result of a teach run.

    Raises:
        MissingRunError: it has not run.
        SchemaError: the file was changed after its run, or holds more than tensors in plain containers.
    """
    return loaded_file(run.require().file(FITTED))


def loaded_file(path: Path) -> Any:
    """The content of the file of a model."""
    return archives.tensors(path, "model", "teach")


def _yardstick(pipeline, manifold: Manifold, lessons: Lessons) -> Yardstick:
    """The validation runs that choose the weights."""
    model, steps = pipeline.model, pipeline.scene.steps
    stride, (particles, at) = model.stride_of(steps), manifold.at_some()
    stored, truth = pipeline.config.data.every, []
    together = math.lcm(stride, stored)  # steps between frames that are stored and end a stride
    apart = together * max(1, steps // together // _FRAMES)
    for case in pipeline.lessons[2]:
        with Trajectory.of(pipeline.simulation(case).require()) as trajectory:
            frames = list(range(0, trajectory.frames, apart // stored))
            truth.append(torch.as_tensor(trajectory.read("x", frames=frames, particles=particles)))

    def positions(xhat: torch.Tensor) -> torch.Tensor:
        with torch.no_grad():
            return at.position(xhat.to(at.device)).double().cpu()

    runs = Runs.of(lessons, stride, model.stress_of(pipeline.forced))
    return Yardstick(runs, positions, torch.stack(truth, 1).double(), apart // stride, stride)
