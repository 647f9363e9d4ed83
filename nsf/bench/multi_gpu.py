"""What several GPUs of a host save in the training of `field=mlp`."""

import os
from collections.abc import Callable, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pandas as pd

from nsf import config
from nsf.bench.measure import name_of
from nsf.bench.rows import Result, Row, Settings, commit
from nsf.kinematics.training.phases import PHASES
from nsf.mpm.device import visible_gpus
from nsf.pipeline import Pipeline

#: Of the paper's 20 values of sand; a step of training takes no longer with more.
_TRAIN = (21.0, 26.53, 32.05, 38.5)
_STEPS = 600  # of each phase
_FRAMES = 32  # of a batch, at most: as many as can be shared evenly


def run(settings: Settings, found: Result, say: Callable[[str], object]) -> None:
    """One GPU beside all: the networks of sand at the paper's size, whose steps are timed in blocks.

    Where there are no two GPUs this says so, and has no rows.
    """
    gpus = len(visible_gpus())
    if gpus < 2:
        say(f"multi_gpu: left out, as it needs two GPUs and this process has {gpus}")
        return
    overrides = (
        "scene=sand", "scale=paper", "field=mlp", f"trainer.steps={_STEPS}",
        f"trainer.frames_per_batch={_FRAMES // gpus * gpus}",
        f"scene.design.train={list(_TRAIN)}", "scene.design.test=[]",
    )  # fmt: skip
    measured(overrides, gpus, settings, found, say)


def measured(
    overrides: Sequence[str], devices: int, settings: Settings, found: Result, say: Callable[[str], object]
) -> None:
    """Add the rows of one configuration, whose trajectories are made first.

    Args:
        overrides: of the configuration, with `field=mlp`; several blocks of steps.
        devices: how many there are.
        settings: the device that is alone, and the precisions, of which the last is that of the trajectories.
        found: gets the rows.
        say: told of every result.
    """
    root = Path(os.environ.get("NSF_RUNS") or "runs").expanduser()
    root.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory(prefix=".bench-", dir=root) as folder:

        def chain(*own: str) -> Pipeline:
            keys = [*overrides, f"precision={settings.precisions[-1]}", *own]
            return Pipeline(config.load(keys), lambda line: None, Path(folder))

        alone = chain(f"device={settings.device}")
        alone.simulate()
        first = _trained(alone, 1, settings, found, say)
        last = _trained(chain("device=auto", f"trainer.devices={devices}"), devices, settings, found, say)
        say(f"train_mlp: {first / last:.3g} times as fast on {devices} devices")


def _trained(pipeline: Pipeline, devices: int, settings: Settings, found: Result, say) -> float:
    """Sum over the phases of a training step's median time [ms]; the first block of each is a warm-up."""
    folder, schedule, total = pipeline.train().path, pipeline.trainer, 0.0
    points = schedule.frames_per_batch * schedule.particles_per_batch
    precision = "bf16" if schedule.bf16 and pipeline.device.startswith("cuda") else "fp32"
    for phase in PHASES:
        rates = pd.read_csv(folder / phase / "csv" / "0" / "metrics.csv")["steps_per_second"]
        ms = 1e3 / rates.to_numpy()[1:]
        case = f"train_mlp_{phase}_on_{devices}"
        found.rows.append(_row(case, pipeline, points, precision, settings, ms))
        say(f"{case}: {1e3 * points / np.median(ms):.4g} samples a second")
        total += float(np.median(ms))
    return total


def _row(case, pipeline: Pipeline, batch: int, precision: str, settings: Settings, ms: np.ndarray) -> Row:
    p10, median, p90 = np.percentile(ms, [10, 50, 90]).tolist()
    return Row(
        bench="multi_gpu", case=case, particles=len(pipeline.scene.particles()), sample=None,
        integration=None, batch=batch, precision=precision, device=name_of(settings.device),
        ms_median=median, ms_p10=p10, ms_p90=p90, peak_mib=None, delta=None, commit=commit(),
    )  # fmt: skip
