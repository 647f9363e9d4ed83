"""Reduced simulations of many cases that take their steps together, by their number."""

from collections.abc import Callable
from functools import partial

import numpy as np
import torch

from nsf import config
from nsf.bench.measure import build, name_of, run_times
from nsf.bench.reduced import SCENES, deformation_error, samplers
from nsf.bench.rows import Result, Row, Settings, commit
from nsf.data import Case
from nsf.data.schema import TRAJECTORY
from nsf.pipeline import Pipeline
from nsf.scenes.designs import evenly

#: Simulations of a batch.
SIZES = {"cuda": (1, 4, 16, 64, 256), "cpu": (1, 4)}
_SHARE = 0.8  # of the free device memory that a batch may be expected to take


def run(settings: Settings, found: Result, say: Callable[[str], object]) -> None:
    """Each scene: at the paper's size on a GPU, at small scale on a CPU.

    Data and training are made, or reused, as by `nsf train`. The first simulation of a batch is that of the
    first held-out case, of which δ is told; the others fill the box of training. Sample particles
    are chosen in the scene's own way, or as the name of a case says.
    """
    kind = "cuda" if settings.device.startswith("cuda") else "cpu"
    scale = {"cuda": "paper", "cpu": "small"}[kind]
    for scene in settings.scenes or SCENES:
        for end, own in samplers(scene).items():
            overrides = [f"scene={scene}", f"scale={scale}", f"device={settings.device}", *own]
            measured(Pipeline(config.load(overrides), say=say), SIZES[kind], settings, found, say, end)


def measured(
    chain: Pipeline, sizes, settings: Settings, found: Result, say: Callable[[str], object], end: str = ""
) -> None:
    """Add the rows of one scene, whose cases end so; all of a precision turn by turn, in whole runs."""
    chain.simulate(("train",))
    chain.train()
    manifold, scene = chain.manifold(), chain.scene
    truth = chain.truth(chain.held_out[0]).path / TRAJECTORY
    first = chain.solver_at(manifold, chain.held_out[0])
    samples, sets, particles = first.samples, first.sets, len(first.state)
    del first  # its arrays are on the device
    how = {"sources": chain.sources, "projector": chain.projector, "integration": chain.integration}

    def make(size: int, precision: str):
        options = how | {"sets": sets, "precision": precision, "device": settings.device}
        return scene.reduced_batch(manifold, cases_of(chain, size), samples, **options)

    for precision in settings.precisions:
        built: dict[int, tuple] = {}
        for size in sorted(sizes):
            if _too_large(size, {n: solver.nbytes for n, (solver, _) in built.items()}, settings.device):
                say(f"reduced_batch{size}{end} {precision}: left out, the device has not the memory")
                break
            built[size] = build(partial(make, size, precision), settings.device)
        times = run_times({n: solver for n, (solver, _) in built.items()}, settings.trials, settings.device)
        for size, (solver, peak_mib) in built.items():
            p10, median, p90 = (np.percentile(times[size], [10, 50, 90]) / size).tolist()
            run = solver.runs[0]
            row = Row(
                bench="batch", case=f"reduced_batch{size}{end}", particles=particles, batch=size,
                sample=run.sample_size, integration=round(run.integration_mean), precision=precision,
                device=name_of(settings.device), ms_median=median, ms_p10=p10, ms_p90=p90,
                peak_mib=peak_mib, delta=deformation_error(run, truth), commit=commit(),
            )  # fmt: skip
            found.rows.append(row)
            error = f"δ {100 * row.delta:.3g} %"
            say(f"{row.case} {scene.name} {precision}: {median:.4g} ms a simulation-step, {error}")


def cases_of(chain: Pipeline, size: int) -> list[Case]:
    """Cases of a batch: the first held-out one, and others in the box of training.

    Those of a small batch are the first ones of a large one: building a scene takes a moment.
    """
    low, high = chain.split.box.T
    return [chain.held_out[0], *map(chain.scene.case, low + (high - low) * evenly(size - 1, len(low)))]


def _too_large(size: int, nbytes: dict[int, int], device: str) -> bool:
    """Whether a batch would not fit on the device beside those built, by what the last two of them take."""
    if not device.startswith("cuda") or len(nbytes) < 2:
        return False
    (one, few), (more, many) = list(nbytes.items())[-2:]
    free, _ = torch.cuda.mem_get_info(device)
    return many + (size - more) * (many - few) / (more - one) > _SHARE * free
