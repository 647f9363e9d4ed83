"""Reduced simulations of many cases that take their steps together, by their number."""

from collections.abc import Sequence
from functools import partial

import torch

from nsf.bench.measure import WholeRun, build, turns
from nsf.bench.reduced import deformation_error, pipelines, prepared
from nsf.bench.rows import Case, Measurements
from nsf.data import Case as Parameters
from nsf.engines import reduced_batch
from nsf.pipeline import Pipeline
from nsf.scenes.designs import evenly

#: Simulations of a batch.
SIZES = {"cuda": (1, 4, 16, 64, 256), "cpu": (1, 4)}
_SHARE = 0.8  # of the free device memory that a batch may be expected to take


def run(figures: Measurements) -> None:
    """Each scene: at the paper's size on a GPU, at small scale on a CPU.

    Data and training are made, or reused, as by `nsf train`. The first simulation of a batch is that of the
    first held-out case, of which δ is told; the others fill the box of training. Sample particles
    are chosen in the scene's own way, or as the name of a case says.
    """
    for end, chain in pipelines(figures, samplers=True):
        measured(chain, SIZES["cuda" if figures.settings.on_gpu else "cpu"], figures, end)


def measured(chain: Pipeline, sizes: Sequence[int], figures: Measurements, end: str = "") -> None:
    """Add the rows of one scene, whose cases end so; all of a precision turn by turn, in whole runs."""
    manifold, truth, how = prepared(chain)
    settings, scene = figures.settings, chain.scene

    def make(size: int, precision: str):
        options = how | {"precision": precision, "device": settings.device}
        samples = options.pop("sample")
        return reduced_batch(scene, manifold, cases_of(chain, size), samples, **options)

    for precision in settings.precisions:
        built: dict[int, tuple] = {}
        for size in sorted(sizes):
            if _too_large(size, {n: solver.nbytes for n, (solver, _) in built.items()}, settings.device):
                figures.say(f"reduced_batch{size}{end} {precision}: left out, the device has not the memory")
                break
            built[size] = build(partial(make, size, precision), settings.device)
        sides = {n: WholeRun(solver, scene.steps) for n, (solver, _) in built.items()}
        times = turns(sides, settings.trials, settings.device)
        for size, (solver, peak) in built.items():
            run = solver.runs[0]
            case = Case(
                bench="batch", name=f"reduced_batch{size}{end}", particles=len(manifold.X), batch=size,
                sample=run.sample_size, integration=round(run.integration_mean), precision=precision,
            )  # fmt: skip
            ms = figures.add(case, "step", times[size] / size / scene.steps)
            figures.add(case, "peak memory", peak, "MiB")
            delta = figures.add(case, "δ", deformation_error(run, truth), "1")
            error = f"δ {100 * delta:.3g} %"
            figures.say(f"{case.name} {scene.name} {precision}: {ms:.4g} ms a simulation-step, {error}")


def cases_of(chain: Pipeline, size: int) -> list[Parameters]:
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
