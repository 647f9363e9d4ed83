"""Whole runs as a user waits for them: every frame decoded, with the spread of members as error bar.

Beside a run by recurrence stand the full-order run in both precisions, and one on a grid twice as coarse. A
run goes from t = 0 to the end of its scene; building is apart, as the seconds until the first frame.
"""

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import torch

from nsf import config
from nsf.bench.measure import build
from nsf.bench.rows import Case, Measurements, size_name
from nsf.bench.scaling import at_size
from nsf.data import Case as Parameters
from nsf.deployment import Trust
from nsf.errors import NSFError
from nsf.evaluation import metrics
from nsf.evaluation.rivals import coarse_scene
from nsf.evaluation.superresolution import interpolated
from nsf.kinematics.manifold import Restriction
from nsf.pipeline import Pipeline
from nsf.scenes import Scene
from nsf.timing import elapsed_ms, synchronizer
from nsf.vectors import spaced

#: Scenes on each kind of device, and numbers of particles where a scene has others than its own.
SCENES = {
    "cuda": ("sand", "metal", "cake"),
    "cpu": ("sand", "metal", "cake", "bread", "toothpaste", "jelly_cube", "squishy_ball"),
}
SIZES = {"sand": (71_363, 250_000, 1_000_000)}
#: What is trained and taught, in a minute or so: the benchmark's times do not depend on it, its errors do.
QUICK = {
    "cuda": ("trainer.steps=3000", "model.runs=24", "model.descents=1000", "model.members=4"),
    "cpu": (
        "trainer.steps=600", "model.runs=8", "model.descents=300", "model.members=2", "model.width=48",
    ),
}  # fmt: skip
_TRAINED, _STORED = 6, 50  # training cases, and frames of each, at most
_ROUND = 10  # steps of a run of another size are a multiple, so that strides and coarse steps divide them
_COARSE = 2  # times Δx
_FRAMES = 5  # at which errors are taken, evenly spread over a run
_HIDDEN = 0.1  # of the model's error, by which decoding may be off


def run(figures: Measurements) -> None:
    """Each scene at each of its sizes: the paper's on a GPU, sand also larger; small ones on a CPU.

    Data, training and teaching are made, or reused, as by `nsf teach model=recurrence`, quickly: with few
    runs, steps and descents. Rows are written as they come.
    """
    settings, kind = figures.settings, "cuda" if figures.settings.on_gpu else "cpu"
    for scene in settings.scenes or SCENES[kind]:
        for particles in settings.particles or (SIZES.get(scene, (None,)) if settings.on_gpu else (None,)):
            chain, values = quick_chain(scene, particles, figures)
            measured(chain, figures, chain.scene.case(values))
            figures.save()


def quick_chain(scene: str, particles: int | None, figures: Measurements) -> tuple[Pipeline, list]:
    """The chain of a scene at one size, quickly trained and taught, and its first held-out values.

    Its physics are in fp32, and no full-order run is stored but those that train and validate it.
    """
    settings = figures.settings
    keys = [f"scene={scene}", f"scale={settings.scale}", f"device={settings.device}", "precision=fp32"]
    keys += ["model=recurrence", "sampler=random", *QUICK["cuda" if settings.on_gpu else "cpu"]]
    keys += ["deploy.split=validation", *settings.keys]
    plain = config.load(keys)
    if particles:
        keys += _size_keys(Pipeline(plain).scene, particles)
    design = plain.scene.design
    steps = config.load(keys).scene.steps
    every = min(k for k in range(1, steps + 1) if steps % k == 0 and steps // k <= _STORED)
    keys += [f"data.every={every}"] if settings.on_gpu and "every" in plain.data else []
    keys += _design_keys(design)
    return Pipeline(config.load(keys), say=figures.say), [design.test[0]]


def _size_keys(scene: Scene, particles: int) -> list[str]:
    """Keys of the same body of so many particles, on a grid and in steps as much finer, of as long a run."""
    if particles == scene.particle_count:
        return []
    fine = at_size(scene, particles)
    steps = _ROUND * max(1, round(fine.steps / _ROUND))
    keys = {"scene.dx": fine.dx, "scene.dt": scene.dt * scene.steps / steps, "scene.steps": steps}
    keys |= {f"scene.bodies.{name}.particles": body.particles for name, body in fine.bodies.items()}
    return [f"{key}={value}" for key, value in keys.items()]


def _design_keys(design: Mapping[str, Any]) -> list[str]:
    """Keys of few of the values of a design; one validates, and none is held out."""
    train = list(design.train)
    some = np.unique(np.linspace(0, len(train) - 1, min(len(train), _TRAINED)).round().astype(int))
    chosen = {"train": [train[k] for k in some], "validation": design.validation[:1], "test": []}
    return [f"scene.design.{split}={list(values)}" for split, values in chosen.items()]


class FullOrder:
    """A full-order run; its state stays on the device."""

    def __init__(self, scene: Scene, precision: str, device: str):
        self.scene = scene
        self.solver, self.peak = build(partial(scene.full_order, None, precision, device), device)
        self.restart = self.solver.restart

    def run(self) -> None:
        """Take every step."""
        self.solver.step(self.scene.steps)

    def positions_after(self, steps: Sequence[int]) -> list[torch.Tensor]:
        """Positions [P, 3] [m] after some numbers of steps, ascending, in fp64 on the host."""
        self.restart()
        frames = []
        for step in steps:
            self.solver.step(step - self.solver.steps_taken)
            frames.append(torch.as_tensor(self.solver.state.x.numpy()).double())
        return frames


class Decoded:
    """A run by recurrence whose positions are decoded at every frame, in fp32, and stay on the device.

    Args:
        solver: a `ReducedMPM`.
        at: the fields at all particles, in fp32.
        tolerance: by which decoding may be off; see `Restriction.positions`.
        error_bar: whether the run says of its error what bounds it (`Trust.signal`).
    """

    def __init__(self, solver, at: Restriction, tolerance: float, error_bar: bool = True):
        self.solver, self._at, self._tolerance = solver, at, tolerance
        self.restart = solver.restart
        self._trust = Trust.of(solver.manifold, 1.0) if error_bar else None
        self.signal: np.ndarray | None = None

    def run(self) -> None:
        """Take every step and decode every frame."""
        self.solver.step(self.solver.total_steps)
        if self._trust is not None:
            self.signal = self._trust.signal_of(self.solver)
        for _ in self._at.positions(self.solver.record.xhat, self._tolerance):
            pass

    def positions_after(self, steps: Sequence[int]) -> list[torch.Tensor]:
        """Positions [P, 3] [m] after some numbers of steps, in fp64 on the host."""
        self.restart()
        self.run()
        rows = self.solver.record.xhat[list(steps)]
        return [x.double().cpu() for block in self._at.positions(rows, self._tolerance) for x in block]


def turns(sides: Mapping[Case, Any], trials: int, limit: float, device: str) -> dict[Case, list[float]]:
    """Time [ms] of whole runs of each side from t = 0, turn by turn; the first ones load, and do not count.

    Args:
        sides: with `restart` and `run`.
        trials: of each, at least two.
        limit: [s] after which no further turn begins.
        device: of all.
    """
    wait, taken, begun = synchronizer(device), {name: [] for name in sides}, time.perf_counter()
    for trial in range(max(2, trials) + 1):
        for name, side in sides.items():
            side.restart()
            ms = elapsed_ms(side.run, wait)
            if trial:
                taken[name].append(ms)
        if trial > 1 and time.perf_counter() - begun > limit:
            break
    return taken


@torch.no_grad()
def measured(chain: Pipeline, figures: Measurements, held_out: Parameters) -> None:
    """Add the rows of one scene.

    Args:
        chain: of the scene, with `model=recurrence`.
        figures: gets the rows.
        held_out: the case of all runs.
    """
    chain.simulate(("train",))
    chain.train()
    chain.teach()
    settings, scene = figures.settings, chain.scene.at(held_out)
    device, name = settings.device, f"{scene.name}_{size_name(scene.particle_count)}"
    of = partial(Case, bench="whole", particles=scene.particle_count)
    sides: dict[Case, FullOrder | Decoded] = {
        of(name=f"full_order_{name}", precision=p): FullOrder(scene, p, device) for p in settings.precisions
    }
    truth = sides[of(name=f"full_order_{name}", precision=max(settings.precisions))]
    try:
        coarse = coarse_scene(scene, {}, _COARSE)
        sides[of(name=f"coarse_{name}", precision="fp32")] = FullOrder(coarse, "fp32", device)
    except NSFError as error:
        figures.say(f"coarse_{name}: left out: {error}")
    recurrence = of(name=f"recurrence_{name}", precision="fp32")
    sides[recurrence], plain = _reduced(chain, held_out, recurrence, figures)
    sides[replace(recurrence, name=f"{recurrence.name}_no_error_bar")] = plain
    times = turns(sides, settings.trials, settings.limit, device)
    for case, ms in times.items():
        figures.add(case, "run", ms)
        if isinstance(sides[case], FullOrder):
            figures.add(case, "peak memory", sides[case].peak, "MiB")
    _add_errors(figures, sides, truth)
    _add_ratios(figures, recurrence, times)


def _reduced(
    chain: Pipeline, held_out: Parameters, case: Case, figures: Measurements
) -> tuple[Decoded, Decoded]:
    """The run by recurrence with its error bar, and without it; adds memory and the time until a frame."""
    device, manifold = figures.settings.device, chain.manifold()
    solver, peak = build(partial(chain.solver_at, manifold, held_out), device)
    at = manifold.restrict(dtype=torch.float32, device=device)
    figures.add(case, "peak memory", peak, "MiB")
    figures.add(case, "memory of a run", solver.nbytes / 2**20, "MiB")
    figures.add(case, "memory of decoding", at.nbytes / 2**20, "MiB")
    figures.add(case, "first frame", _ready_seconds(chain, held_out, device), "s")
    tolerance = _HIDDEN * min(chain.taught.metric("errors", kind=[float]))
    return Decoded(solver, at, tolerance), Decoded(solver, at, tolerance, error_bar=False)


def _ready_seconds(chain: Pipeline, held_out: Parameters, device: str) -> float:
    """Time [s] from the files of a deployed model to the first decoded frame, nothing compiled anew."""
    fresh = Pipeline(chain.config, say=lambda line: None, root=chain.root)

    def first_frame() -> None:
        manifold = fresh.manifold()
        run = fresh.solver_at(manifold, held_out)
        run.step(fresh.model.stride_of(fresh.scene.steps))
        next(manifold.restrict(dtype=torch.float32, device=device).positions(run.xhat[None]))

    return 1e-3 * elapsed_ms(first_frame, synchronizer(device))


def _add_errors(figures: Measurements, sides: Mapping[Case, FullOrder | Decoded], truth: FullOrder) -> None:
    """Add the displacement error of each reduced and coarse run over some frames, and the error bar."""
    scene = truth.scene
    steps = spaced(scene.steps + 1, _FRAMES + 1)[1:]
    X, x = torch.as_tensor(scene.particles().X), torch.stack(truth.positions_after(steps.tolist()))
    moved = float(metrics.frame_squares(x - X).sum())
    for case, side in sides.items():
        if case.precision != "fp32" or side is truth or case.name.startswith("full_order"):
            continue
        if isinstance(side, Decoded):
            off = torch.stack(side.positions_after(steps.tolist())) - x
            if side.signal is not None:
                size = (moved / len(x) / len(X)) ** 0.5
                figures.add(case, "error bar", float(np.sqrt(np.mean(side.signal[steps] ** 2))) / size, "1")
        else:
            off = X + _carried(side, steps * side.scene.steps // scene.steps, X, figures.settings.device) - x
        error = float(metrics.frame_squares(off).sum() / moved) ** 0.5
        figures.say(f"{case.name}: displacement error {100 * figures.add(case, 'error', error, '1'):.3g} %")


def _carried(side: FullOrder, steps: Sequence[int], X: torch.Tensor, device: str) -> torch.Tensor:
    """Displacements [F, n, 3] [m] of a coarse run after some steps, at points X [n, 3] [m]."""
    particles = torch.as_tensor(side.scene.particles().X)
    moved = torch.stack([x - particles for x in side.positions_after(list(steps))])
    return interpolated(*(values.to(device) for values in (X, particles, moved))).cpu()


def _add_ratios(figures: Measurements, recurrence: Case, times: Mapping[Case, Sequence[float]]) -> None:
    """Add how many times as long the others take as the run by recurrence, all of its frames decoded."""
    own = float(np.median(times[recurrence]))
    for case, ms in times.items():
        if case is not recurrence:
            of = case.name.removesuffix(recurrence.name.removeprefix("recurrence")).replace("_", " ")
            what = "without error bar" if of.startswith("recurrence") else f"{of} {case.precision}"
            ratio = figures.add(recurrence, f"time of {what} over it", float(np.median(ms)) / own, "1")
            figures.say(f"{recurrence.name}: {own:.4g} ms; {what}: {ratio:.4g} times")
