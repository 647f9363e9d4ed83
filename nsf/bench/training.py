"""How long the networks of a scene take to train with `field=basis`, on the paper's cake and metal."""

import contextlib
import time
from pathlib import Path
from tempfile import TemporaryDirectory

from nsf.bench.measure import peak_mib
from nsf.bench.reduced import pipelines
from nsf.bench.rows import Case, Measurements
from nsf.data import Snapshots
from nsf.data.schema import TRAJECTORY
from nsf.kinematics.training.train import train
from nsf.pipeline import Pipeline

_MOST = 3  # trainings of a scene; a seed each


def run(figures: Measurements) -> None:
    """Both scenes: at the paper's size on a GPU, at small scale on a CPU; the precision of networks is fp32.

    Data are made, or reused, as by `nsf simulate`. A training goes from its files to the manifold.
    """
    for _, chain in pipelines(figures):
        measured(chain, figures)


def measured(chain: Pipeline, figures: Measurements) -> None:
    """Add the time of whole trainings of one scene [ms]."""
    chain.simulate()
    paths = [chain.simulation(case).path / TRAJECTORY for case in chain.split.train]
    times, peaks, name = [], [], f"training_{chain.scene.name}"

    def once(seed: int, folder: str) -> None:
        with contextlib.closing(Snapshots(paths, chain.device, chain.config.data.resident)) as snapshots:
            train(
                snapshots, chain.field, trainer=chain.trainer, latent_dim=chain.config.latent_dim, seed=seed,
                folder=Path(folder), device=chain.device,
            )  # fmt: skip

    for seed in range(min(figures.settings.trials, _MOST)):
        with TemporaryDirectory() as folder:
            begun = time.perf_counter()
            peaks.append(peak_mib(lambda seed=seed, folder=folder: once(seed, folder), chain.device))
            times.append(1e3 * (time.perf_counter() - begun))
        figures.say(f"{name}: {times[-1] / 1e3:.3g} s")
    case = Case(bench="training", name=name, particles=len(chain.scene.particles()), precision="fp32")
    figures.add(case, "training", times)
    if any(peaks):
        figures.add(case, "peak memory", max(peaks), "MiB")
