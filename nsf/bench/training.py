"""How long the networks of a scene take to train with `field=basis`, on the paper's cake and metal."""

import contextlib
import time
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from nsf import config
from nsf.bench.measure import name_of, peak_mib
from nsf.bench.reduced import SCENES, scale_of
from nsf.bench.rows import Result, Row, Settings, commit
from nsf.data import Snapshots
from nsf.data.schema import TRAJECTORY
from nsf.kinematics.training.train import train
from nsf.pipeline import Pipeline

_MOST = 3  # trainings of a scene; a seed each


def run(settings: Settings, found: Result, say: Callable[[str], object]) -> None:
    """Both scenes: at the paper's size on a GPU, at small scale on a CPU; the precision of networks is fp32.

    Data are made, or reused, as by `nsf simulate`. A training goes from its files to the manifold.
    """
    for scene in settings.scenes or SCENES:
        overrides = [f"scene={scene}", f"scale={scale_of(settings.device)}", f"device={settings.device}"]
        measured(Pipeline(config.load(overrides), say=say), settings, found, say)


def measured(chain: Pipeline, settings: Settings, found: Result, say: Callable[[str], object]) -> None:
    """Add the row of one scene, whose time is that of a whole training [ms]."""
    chain.simulate()
    paths = [chain.simulation(case).path / TRAJECTORY for case in chain.split.train]
    times, peaks, name = [], [], chain.scene.name

    def once(seed: int, folder: str) -> None:
        with contextlib.closing(Snapshots(paths, chain.device, chain.config.data.resident)) as snapshots:
            train(
                snapshots, chain.field, trainer=chain.trainer, latent_dim=chain.config.latent_dim, seed=seed,
                folder=Path(folder), device=chain.device,
            )  # fmt: skip

    for seed in range(min(settings.trials, _MOST)):
        with TemporaryDirectory() as folder:
            begun = time.perf_counter()
            peaks.append(peak_mib(lambda seed=seed, folder=folder: once(seed, folder), chain.device))
            times.append(1e3 * (time.perf_counter() - begun))
        say(f"training_{name}: {times[-1] / 1e3:.3g} s")
    p10, median, p90 = np.percentile(times, [10, 50, 90]).tolist()
    row = Row(
        bench="training", case=f"training_{name}", particles=len(chain.scene.particles()), sample=None,
        integration=None, batch=1, precision="fp32", device=name_of(settings.device), ms_median=median,
        ms_p10=p10, ms_p90=p90, peak_mib=max(peaks) or None, delta=None, commit=commit(),
    )  # fmt: skip
    found.rows.append(row)
