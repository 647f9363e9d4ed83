"""Seconds that a stage will take: typical ones for its work, mended by what like work took in the same store.

Each stage that a chain makes adds a line to `times.csv` of its store of runs: its seconds beside the typical
ones. The ratio of the two in earlier lines, and its spread, make the interval that `nsf plan` shows.
"""

import csv
import io
import math
import os
import statistics
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import astuple, dataclass
from operator import itemgetter
from pathlib import Path

from nsf.errors import ConfigError
from nsf.models import Auto, Projected
from nsf.runs import Run
from nsf.scenes.checks import host_bytes

FILE = "times.csv"
#: [s] of a command beside its stages: Python and libraries begin.
START = 6.0

#: On two cores of a server, and on an H200: seconds of a piece of work, of a step in it, of a part of a step.
_TYPICAL = {
    "full": ((0.05, 3e-4, 2e-6), (0.3, 1e-4, 2e-8)),  # a full-order run; particles
    "train": ((2.0, 2e-3, 4e-6), (2.0, 4e-4, 2e-7)),  # snapshots or points
    "modes": ((0.0, 0.0, 1.5e-9), (0.0, 0.0, 2e-12)),  # of a field: snapshots; particles of each other one
    "descend": ((0.0, 7e-4, 2.5e-10), (0.0, 3e-4, 1e-13)),  # strides in a window; weights
    "reduced": ((0.15, 5e-4, 3e-5), (1.0, 1e-4, 1e-7)),  # a reduced run; sample particles
    "compare": ((0.0, 0.0, 1e-6), (0.0, 0.0, 3e-7)),  # frames; particles
    "report": ((12.0, 4.0, 0.0), (12.0, 4.0, 0.0)),  # a page; bodies on it
}
_SNAPSHOTS, _WINDOW = 6000, 50  # of a step of training at most; strides of a window, in the mean
_DESCENT = {"members": 1, "batch": 64, "width": 96}  # where a model has no number of its own
_NEWEST = 2**18  # [byte] of the file that are read
_NEAR, _MOST = 0.1, 12  # how much less alike than the most alike line others may be, and how many count
_SURE = 1.64  # deviations to either side that hold nine of ten values of a normal distribution
_NOISE, _PRIOR = 0.35, 3  # deviation of the logarithm of a time of like work, and the lines it counts as
#: Likewise between scenes, kinds, and a factor of e in work; and where nothing was measured.
_OTHER_SCENE, _OTHER_KIND, _OTHER_SIZE, _UNMEASURED = 0.35, 0.6, 0.08, 0.65


@dataclass(frozen=True)
class Work:
    """Runs to be made by a stage.

    Attributes:
        stage, scene, kind, device: `kind` is the field that is trained, or the model.
        expected: typical seconds.
    """

    stage: str
    scene: str
    kind: str
    device: str
    expected: float


@dataclass(frozen=True)
class Interval:
    """Wall time [s] that holds nine of ten, and the work that it rests on; `like` is empty where none is."""

    low: float
    high: float
    like: str = ""


@contextmanager
def measured(pipeline, stage: str) -> Iterator[list[Work]]:
    """Add the time of the block, in which a pipeline does the work of a stage, to the times of its store.

    Yields:
        The work, at most one, that is added after the block, which clears it where others did a part.
    """
    works, started = _whole(pipeline, stage), time.monotonic()
    yield works
    for work in works:
        *names, expected = astuple(work)
        seconds, line = time.monotonic() - started, io.StringIO()
        csv.writer(line, lineterminator="\n").writerow([*names, f"{expected:.4g}", f"{seconds:.4g}"])
        with suppress(OSError), (pipeline.training.root / FILE).open("a", encoding="utf-8") as file:
            file.write(line.getvalue())


def _whole(pipeline, stage: str) -> list[Work]:
    """The work of a stage; none where a part of it is done, or where a user's class allows no estimate."""
    try:
        runs = due(pipeline, stage)
        if not runs or (stage in _SECONDS and any(map(_begun, runs))):
            return []
        return [work_of(pipeline, stage, runs.values())]
    except Exception:  # what is wrong with a stage, the stage says
        return []


def _begun(run: Run) -> bool:
    """Whether the folder of a run has files, beside its lock."""
    return any(not path.name.startswith(".") for path in run.path.glob("*"))


def times(folder: Path) -> list[tuple[Work, float]]:
    """Work that was done in a store of runs, with its seconds, the newest first; other lines are left out."""
    try:
        with (folder / FILE).open("rb") as file:
            file.seek(max(0, file.seek(0, io.SEEK_END) - _NEWEST))
            lines = file.read(_NEWEST).decode(errors="replace").splitlines()
    except OSError:
        return []
    done = []
    for line in reversed(lines):
        with suppress(ValueError, TypeError, StopIteration, csv.Error):
            *names, expected, seconds = next(csv.reader([line]))
            if min(float(expected), float(seconds)) > 0.0 and float(expected) + float(seconds) < math.inf:
                done.append((Work(*names, float(expected)), float(seconds)))
    return done


# -- the interval of some work --------------------------------------------------------------------------


def crowding() -> float:
    """How many times as long work takes beside the other work of this machine's last minute."""
    load = 0.0
    with suppress(OSError, AttributeError):  # not every system tells
        load = os.getloadavg()[0]
    return max(1.0, load / (os.cpu_count() or 1))


def interval(work: Work, times: Sequence[tuple[Work, float]]) -> Interval:
    """The time of some work, by typical times and by what the most alike of earlier work took beside them."""
    alike = [
        (_unlike(work, other), math.log(seconds / other.expected))
        for other, seconds in times
        if (other.stage, other.device) == (work.stage, work.device)
    ]
    alike.sort(key=itemgetter(0))
    near = [pair for pair in alike if pair[0] <= alike[0][0] + _NEAR][:_MOST]
    if not near or near[0][0] >= _UNMEASURED:
        return _around(work.expected, _UNMEASURED, "")
    ratios, n, least = [ratio for _, ratio in near], len(near), near[-1][0]
    middle = statistics.median(ratios)
    spread = sum((ratio - middle) ** 2 for ratio in ratios)
    noise = (spread + _PRIOR * _NOISE**2) / (n + _PRIOR) * (1 + 1 / n)
    how = "" if least < _OTHER_SCENE else ", other scenes" if least < _OTHER_KIND else ", unlike"
    seconds = work.expected * math.exp(middle)
    return _around(seconds, math.sqrt(noise + least**2), f"{n} time{'s' * (n > 1)}{how}")


def _unlike(work: Work, other: Work) -> float:
    """Deviation of the logarithm of a ratio of times between two pieces of work of a stage."""
    size = _OTHER_SIZE * abs(math.log(work.expected / other.expected))
    return math.hypot(
        _OTHER_SCENE * (work.scene != other.scene), _OTHER_KIND * (work.kind != other.kind), size
    )


def _around(seconds: float, deviation: float, like: str) -> Interval:
    factor = math.exp(_SURE * deviation)
    return Interval(seconds / factor, seconds * factor, like)


# -- typical seconds ------------------------------------------------------------------------------------


def due(pipeline, stage: str) -> dict[Run | Path, float]:
    """The runs, or the folder of the page, that a stage would make now, each with its typical seconds."""
    if stage == "report":
        if pipeline.evaluation.complete and pipeline.complete(["report"]):
            return {}
        page = _typical(pipeline, "report", len(pipeline.reported()))
        return {pipeline.report_folder: page, pipeline.evaluation: _TYPICAL["report"][0][1]}
    missing = [run for run in pipeline.runs_of(stage) if not run.complete]
    if stage == "simulate":
        return dict.fromkeys(missing, _side_by_side(pipeline, len(missing)) / max(1, len(missing)))
    return {run: _SECONDS[stage](pipeline) for run in missing if stage in _SECONDS}


def work_of(pipeline, stage: str, seconds: Iterable[float]) -> Work:
    """Work of a pipeline's stage that typically takes some seconds on a machine without other work."""
    c = pipeline.config
    field, model = str(c.field.get("_target_")).rpartition(".")[2], pipeline.configured.name
    kind = {"train": field, "teach": model}.get(stage, "")
    if stage in ("deploy", "evaluate"):
        kind = f"{model} {c.stress} {field}"
    return Work(stage, pipeline.scene.name, kind, pipeline.device, crowding() * sum(seconds))


def _typical(pipeline, work: str, steps: float = 0.0, parts: float = 0.0) -> float:
    begin, step, part = _TYPICAL[work][pipeline.device != "cpu"]
    return begin + steps * (step + part * parts)


def _full_order(pipeline) -> float:
    return _typical(pipeline, "full", pipeline.scene.steps, pipeline.scene.particle_count)


def _side_by_side(pipeline, count: int) -> float:
    """Some full-order runs, which processes share."""
    from nsf.pipeline.stages.cores import helper_count

    nbytes = host_bytes(pipeline.scene, pipeline.config.precision, pipeline.stored)
    helpers = helper_count(pipeline.device, [pipeline.scene] * count, nbytes) if count else 0
    return math.ceil(count / (1 + helpers)) * _full_order(pipeline)


def _train(pipeline) -> float:
    trainer, particles = pipeline.trainer, pipeline.scene.particle_count
    frames = len(pipeline.split.train) * pipeline.stored_frames
    steps = sum(trainer.steps_of(phase, frames) for phase in ("deformation", "stress", "affine"))
    if pipeline.config.field.get("_target_", "").endswith("MlpField"):
        frames = min(frames, trainer.frames_per_batch)
        return _typical(pipeline, "train", steps, frames * getattr(trainer, "particles_per_batch", particles))
    frames = min(frames, _SNAPSHOTS)
    modes = _typical(pipeline, "modes", frames, frames * particles)
    return modes + _typical(pipeline, "train", steps, frames)


def _encode(pipeline) -> float:
    training, drawn, _ = pipeline.lessons
    streamed = len(drawn) + (len(training) if pipeline.config.data.every > 1 else 0)
    return _typical(pipeline, "full") + _side_by_side(pipeline, streamed)


def _teach(pipeline) -> float:
    model, steps = pipeline.model, pipeline.scene.steps
    seconds = _typical(pipeline, "reduced")
    if pipeline.config.data.every > 1:
        seconds += len(pipeline.lessons[2]) * _full_order(pipeline)
    if hasattr(model, "descents"):
        strides = min(_WINDOW, steps // model.stride_of(steps))
        members, batch, width = (getattr(model, name, None) or n for name, n in _DESCENT.items())
        seconds += _typical(pipeline, "descend", model.descents * strides, members * batch * width**2)
    return seconds


def _reduced(pipeline) -> float:
    """A reduced run."""
    if not isinstance(pipeline.configured, Projected):
        return _typical(pipeline, "reduced")
    size = pipeline.config.sampler.get("size")
    sample = size if isinstance(size, int) else pipeline.config.reduction.sample
    steps = pipeline.deployed.steps / pipeline.config.deploy.dt_multiplier
    return _typical(pipeline, "reduced", steps, sample)


def _deploy(pipeline) -> float:
    seconds = len(pipeline.held_out) * _reduced(pipeline)
    if isinstance(pipeline.configured, Auto) and pipeline.split.validation:
        for name in pipeline.configured.of:
            with suppress(ConfigError):  # a candidate that cannot run is passed over
                alone = pipeline.alone(name)
                seconds += sum(sum(due(alone, stage).values()) for stage in ("encode", "teach", "deploy"))
    return seconds


def _evaluate(pipeline) -> float:
    scene, c = pipeline.deployed, pipeline.config
    cases, sides = len(pipeline.held_out), 2 + len(pipeline.coarse)
    frames = cases * sides * (scene.steps // c.data.every + 1)
    full = _full_order(pipeline)
    coarse = sum(full / factor**3 for factor in pipeline.coarse)
    trials = c.evaluation.trials + 1 if c.evaluation.trials else 0
    compared = _typical(pipeline, "compare", frames, scene.particle_count)
    again = cases * (_typical(pipeline, "reduced") + coarse)
    return compared + again + trials * (full + coarse + _reduced(pipeline))


_SECONDS = {"train": _train, "encode": _encode, "teach": _teach, "deploy": _deploy, "evaluate": _evaluate}
