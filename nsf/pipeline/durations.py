"""The time of a stage: expected by its work, and by what like work took in the same store of runs.

Each piece of work that a chain does adds a line to `times.csv` of the store: its wall time beside that of
`Rates`. The ratio of the two in earlier lines, and its spread, make the interval that `nsf plan` shows.
"""

import csv
import io
import math
import os
import statistics
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from nsf.errors import ConfigError
from nsf.models import Auto, Projected
from nsf.runs import Run
from nsf.scenes.checks import host_bytes

FILE = "times.csv"
STAGES = ("simulate", "train", "encode", "teach", "deploy", "evaluate", "report")
_SNAPSHOTS, _WINDOW = 6000, 50  # of a step of training at most; strides of a window, in the mean
_DESCENT = {"members": 1, "batch": 64, "width": 96}  # where a model has no number of its own
_NEWEST = 2**18  # [byte] of the file that are read
_NEAR, _MOST = 0.1, 12  # how much less alike than the most alike line others may be, and how many count
_SURE = 1.64  # deviations to either side that hold nine of ten values of a normal distribution
_NOISE, _PRIOR = 0.35, 3  # deviation of the logarithm of a time of like work, and the lines it counts as
#: Likewise between scenes, kinds, and a factor of e in work; and where nothing was measured.
_OTHER_SCENE, _OTHER_KIND, _OTHER_SIZE, _UNMEASURED = 0.35, 0.6, 0.08, 0.65


@dataclass(frozen=True)
class Rates:
    """Typical times [s] on a device, where nothing was measured yet.

    Attributes:
        run, step, particle_step: a full-order run, its step, and a particle in it, which is stored.
        training, training_step, training_value: a training, a step of it, and a snapshot or point in that.
        mode: a particle and a pair of snapshots in the modes of a field.
        stride, weight: a stride in a window of the descent, and a weight of a member and window in it.
        reduced_run, reduced_step, sample_step: a reduced run, its step, and a sample particle in it.
        compared: a particle in a frame that is compared.
        report, picture: a page, and a body on it.
    """

    run: float = 0.05
    step: float = 3e-4
    particle_step: float = 2e-6
    training: float = 2.0
    training_step: float = 2e-3
    training_value: float = 4e-6
    mode: float = 1.5e-9
    stride: float = 7e-4
    weight: float = 2.5e-10
    reduced_run: float = 0.15
    reduced_step: float = 5e-4
    sample_step: float = 3e-5
    compared: float = 1e-6
    report: float = 12.0
    picture: float = 4.0


#: Of two cores of a server, and of an H200.
CPU = Rates()
GPU = Rates(
    run=0.3, step=1e-4, particle_step=2e-8, training_step=4e-4, training_value=2e-7, mode=2e-12, stride=3e-4,
    weight=1e-13, reduced_run=1.0, reduced_step=1e-4, sample_step=1e-7, compared=3e-7,
)  # fmt: skip

#: [s] of a command beside its stages: Python and libraries begin.
START = 6.0


@dataclass(frozen=True)
class Work:
    """Runs to be made by a stage.

    Attributes:
        stage, scene, kind, device: `kind` is the field that is trained, or the model.
        expected: seconds by `Rates`.
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
    works, started = _expected(pipeline, stage), time.monotonic()
    yield works
    for work in works:
        _add(pipeline.training.root / FILE, work, time.monotonic() - started)


def _expected(pipeline, stage: str) -> list[Work]:
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


def due(pipeline, stage: str) -> dict[Run | Path, float]:
    """The runs, or the folder of the page, that a stage would make now, each with its seconds by `Rates`."""
    rates = CPU if pipeline.device == "cpu" else GPU
    if stage == "report":
        if pipeline.evaluation.complete and pipeline.complete(["report"]):
            return {}
        page = rates.report + rates.picture * len(pipeline.reported())
        return {pipeline.report_folder: page, pipeline.evaluation: rates.picture}
    missing = [run for run in pipeline.runs_of(stage) if not run.complete]
    if stage == "simulate":
        at_once = missing and _workers(pipeline, len(missing))
        share = math.ceil(len(missing) / at_once) / len(missing) if missing else 0.0
        return dict.fromkeys(missing, share * _full_order(pipeline, rates))
    return {run: _SECONDS[stage](pipeline, rates) for run in missing if stage in _SECONDS}


def work_of(pipeline, stage: str, seconds: Iterable[float]) -> Work:
    """Work of a pipeline's stage that takes some seconds by `Rates`."""
    c = pipeline.config
    field, model = str(c.field.get("_target_")).rpartition(".")[2], pipeline.configured.name
    kind = {"train": field, "teach": model}.get(stage, "")
    if stage in ("deploy", "evaluate"):
        kind = f"{model} {c.stress} {field}"
    return Work(stage, pipeline.scene.name, kind, pipeline.device, crowding() * sum(seconds))


def crowding() -> float:
    """How many times as long work takes beside the other work of this machine's last minute."""
    load = 0.0
    with suppress(OSError, AttributeError):  # not every system tells
        load = os.getloadavg()[0]
    return max(1.0, load / (os.cpu_count() or 1))


def interval(work: Work, times: Sequence[tuple[Work, float]]) -> Interval:
    """The time of some work, by `Rates` and by what the most alike of earlier work took beside them."""
    alike = sorted(
        ((_unlike(work, other), math.log(seconds / other.expected)) for other, seconds in times
         if (other.stage, other.device) == (work.stage, work.device)),
        key=lambda pair: pair[0],
    )  # fmt: skip
    near = [pair for pair in alike if pair[0] <= alike[0][0] + _NEAR][:_MOST]
    if not near or near[0][0] >= _UNMEASURED:
        return _around(work.expected, _UNMEASURED, "")
    ratios, n = [ratio for _, ratio in near], len(near)
    middle = statistics.median(ratios)
    spread = sum((ratio - middle) ** 2 for ratio in ratios)
    noise = (spread + _PRIOR * _NOISE**2) / (n + _PRIOR) * (1 + 1 / n)
    least = near[-1][0]
    how = "" if least < _OTHER_SCENE else ", other scenes" if least < _OTHER_KIND else ", unlike"
    like = f"{n} time{'s' * (n > 1)}{how}"
    return _around(work.expected * math.exp(middle), math.sqrt(noise + least**2), like)


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


def _add(file: Path, work: Work, seconds: float) -> None:
    """Add a line to a store's times; one that cannot be written is left out."""
    text = io.StringIO()
    row = (work.stage, work.scene, work.kind, work.device, f"{work.expected:.4g}", f"{seconds:.4g}")
    csv.writer(text, lineterminator="\n").writerow(row)
    with suppress(OSError), file.open("a", encoding="utf-8") as lines:
        lines.write(text.getvalue())


def _unlike(work: Work, other: Work) -> float:
    """Deviation of the logarithm of a ratio of times between two pieces of work of a stage."""
    size = _OTHER_SIZE * abs(math.log(work.expected / other.expected))
    return math.hypot(
        _OTHER_SCENE * (work.scene != other.scene), _OTHER_KIND * (work.kind != other.kind), size
    )


def _around(seconds: float, deviation: float, like: str) -> Interval:
    factor = math.exp(_SURE * deviation)
    return Interval(seconds / factor, seconds * factor, like)


def _workers(pipeline, count: int) -> int:
    """Processes that share so many full-order runs."""
    from nsf.pipeline.cores import helper_count

    nbytes = host_bytes(pipeline.scene, pipeline.config.precision, pipeline.stored)
    return 1 + helper_count(pipeline.device, [pipeline.scene] * count, nbytes)


def _full_order(pipeline, rates: Rates) -> float:
    scene = pipeline.scene
    return rates.run + scene.steps * (rates.step + rates.particle_step * scene.particle_count)


def _train(pipeline, rates: Rates) -> float:
    trainer, particles = pipeline.trainer, pipeline.scene.particle_count
    frames = len(pipeline.split.train) * pipeline.stored_frames
    pointwise = pipeline.config.field.get("_target_", "").endswith("MlpField")
    at_once = min(frames, trainer.frames_per_batch if pointwise else _SNAPSHOTS)
    values = at_once * getattr(trainer, "particles_per_batch", particles) if pointwise else at_once
    steps = sum(trainer.steps_of(phase, frames) for phase in ("deformation", "stress", "affine"))
    modes = 0.0 if pointwise else rates.mode * at_once**2 * particles
    return rates.training + modes + steps * (rates.training_step + rates.training_value * values)


def _encode(pipeline, rates: Rates) -> float:
    training, drawn, _ = pipeline.lessons
    streamed = len(drawn) + (len(training) if pipeline.config.data.every > 1 else 0)
    shared = math.ceil(streamed / _workers(pipeline, streamed)) if streamed else 0
    return rates.run + shared * _full_order(pipeline, rates)


def _teach(pipeline, rates: Rates) -> float:
    model, steps = pipeline.model, pipeline.scene.steps
    again = len(pipeline.lessons[2]) if pipeline.config.data.every > 1 else 0
    descent = 0.0
    if hasattr(model, "descents"):
        strides = min(_WINDOW, steps // model.stride_of(steps))
        members, batch, width = (getattr(model, name, None) or n for name, n in _DESCENT.items())
        weights = members * batch * width**2
        descent = model.descents * strides * (rates.stride + rates.weight * weights)
    return rates.reduced_run + descent + again * _full_order(pipeline, rates)


def _reduced(pipeline, rates: Rates) -> float:
    """A reduced run."""
    if not isinstance(pipeline.configured, Projected):
        return rates.reduced_run
    size = pipeline.config.sampler.get("size")
    sample = size if isinstance(size, int) else pipeline.config.reduction.sample
    steps = pipeline.deployed.steps / pipeline.config.deploy.dt_multiplier
    return rates.reduced_run + steps * (rates.reduced_step + rates.sample_step * sample)


def _deploy(pipeline, rates: Rates) -> float:
    seconds = len(pipeline.held_out) * _reduced(pipeline, rates)
    if isinstance(pipeline.configured, Auto) and pipeline.split.validation:
        for name in pipeline.configured.of:
            with suppress(ConfigError):  # a candidate that cannot run is passed over
                alone = pipeline.alone(name)
                seconds += sum(sum(due(alone, stage).values()) for stage in ("encode", "teach", "deploy"))
    return seconds


def _evaluate(pipeline, rates: Rates) -> float:
    scene, c = pipeline.deployed, pipeline.config
    frames, cases, coarse = scene.steps // c.data.every + 1, len(pipeline.held_out), len(pipeline.coarse)
    compared = cases * frames * scene.particle_count * (2 + coarse) * rates.compared
    full = _full_order(pipeline, rates)
    coarser = sum(full / factor**3 for factor in pipeline.coarse)
    timed = (c.evaluation.trials + 1) * (full + coarser + _reduced(pipeline, rates))
    return compared + cases * (rates.reduced_run + coarser) + (timed if c.evaluation.trials else 0.0)


_SECONDS = {"train": _train, "encode": _encode, "teach": _teach, "deploy": _deploy, "evaluate": _evaluate}
