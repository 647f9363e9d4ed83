"""Whole runs as a user waits for them: every frame decoded, with the spread of members as error bar.

Beside a run by recurrence stand the full-order run in both precisions, and one on a grid twice as coarse. A
run goes from t = 0 to the end of its scene; building is apart, as the seconds until the first frame.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import torch

from nsf import config
from nsf.bench.measure import WholeRun, build, taught, turns
from nsf.bench.rows import Case, Measurements, size_name
from nsf.bench.scaling import at_size
from nsf.deployment import Trust, Verdict
from nsf.errors import NSFError
from nsf.evaluation import metrics
from nsf.evaluation.rivals import coarse_scene
from nsf.evaluation.superresolution import interpolated
from nsf.kinematics.manifold import Restriction
from nsf.pipeline import Pipeline
from nsf.pipeline.stages.calibration import calibrated
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
_PARTS = ("_no_error_bar", "_not_decoded")  # ends of names, of a run without the one, and without both
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
            chain = quick_chain(scene, particles, figures)
            taught(chain)
            measured(chain, figures)
            figures.save()


def quick_chain(scene: str, particles: int | None, figures: Measurements) -> Pipeline:
    """The chain of a scene at one size, quickly trained and taught; its physics are in fp32."""
    settings = figures.settings
    keys = [f"scene={scene}", f"scale={settings.scale}", f"device={settings.device}", "precision=fp32"]
    keys += ["model=recurrence", "sampler=random", *QUICK["cuda" if settings.on_gpu else "cpu"]]
    keys += settings.keys
    plain = config.load(keys)
    if particles:
        keys += _size_keys(Pipeline(plain).scene, particles)
    steps = config.load(keys).scene.steps
    every = min(k for k in range(1, steps + 1) if steps % k == 0 and steps // k <= _STORED)
    keys += [f"data.every={every}"] if settings.on_gpu else []
    return Pipeline(config.load([*keys, *_design_keys(plain.scene.design)]), say=figures.say)


def _size_keys(scene: Scene, particles: int) -> list[str]:
    """Keys of the same body of so many particles, on a grid and in steps as much finer, of as long a run."""
    if particles == scene.particle_count:
        return []
    fine = at_size(scene, particles)
    steps = _ROUND * math.ceil(fine.steps / _ROUND)  # no longer a step than the finer grid allows
    keys = {"scene.dx": fine.dx, "scene.dt": scene.dt * scene.steps / steps, "scene.steps": steps}
    keys |= {f"scene.bodies.{name}.particles": body.particles for name, body in fine.bodies.items()}
    return [f"{key}={value}" for key, value in keys.items()]


def _design_keys(design: Mapping[str, Any]) -> list[str]:
    """Keys of few of the values of a design: one validates, and one is held out."""
    train = list(design.train)
    some = [train[k] for k in spaced(len(train), _TRAINED)]
    chosen = {"train": some, "validation": design.validation[:1]}
    chosen["test"] = design.test[:1]
    return [f"scene.design.{split}={list(values)}" for split, values in chosen.items()]


class FullOrder(WholeRun):
    """A full-order run; its state stays on the device."""

    def __init__(self, scene: Scene, precision: str, device: str):
        solver, self.peak = build(partial(scene.full_order, None, precision, device), device)
        super().__init__(solver, scene.steps)
        self.scene = scene

    def positions_after(self, steps: Sequence[int]) -> list[torch.Tensor]:
        """Positions [P, 3] [m] after some numbers of steps, ascending, in fp64 on the host."""
        self.restart()
        frames = []
        for step in steps:
            self.solver.step(step - self.solver.steps_taken)
            frames.append(torch.as_tensor(self.solver.state.x.numpy()).double())
        return frames


class Decoded(WholeRun):
    """A run by recurrence whose positions are decoded at every frame, in fp32, and stay on the device.

    Args:
        solver: a `ReducedMPM`.
        at: the fields at all particles, in fp32.
        tolerance: by which decoding may be off; see `Restriction.positions`.
        trust: bounds the error of each run; None for no error bar.
    """

    def __init__(self, solver, at: Restriction, tolerance: float, trust: Trust | None = None):
        super().__init__(solver, solver.total_steps)
        self._at, self._tolerance, self._trust = at, tolerance, trust
        self.verdict: Verdict | None = None

    def run(self) -> None:
        """Take every step and decode every frame."""
        super().run()
        for _ in self._at.positions(self.solver.record.xhat, self._tolerance):
            pass
        if self._trust is not None:  # on the host, while a GPU decodes
            self.verdict = self._trust.of_run(self.solver, self._trust.signal_of(self.solver))

    def positions_after(self, steps: Sequence[int]) -> list[torch.Tensor]:
        """Positions [P, 3] [m] after some numbers of steps, in fp64 on the host."""
        self.restart()
        self.run()
        rows = self.solver.record.xhat[list(steps)]
        return [x.double().cpu() for block in self._at.positions(rows, self._tolerance) for x in block]


@torch.no_grad()
def measured(chain: Pipeline, figures: Measurements) -> None:
    """Add the rows of one scene, in its first held-out case.

    Args:
        chain: of the scene, with `model=recurrence`; taught.
        figures: gets the rows.
    """
    settings, scene = figures.settings, chain.scene.at(chain.held_out[0])
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
    parts = _reduced(chain, recurrence, figures)
    sides |= {replace(recurrence, name=recurrence.name + end): side for end, side in parts.items()}
    times = turns(sides, settings.trials, device, settings.limit)
    for case, ms in times.items():
        figures.add(case, "run", ms)
        if isinstance(sides[case], FullOrder):
            figures.add(case, "peak memory", sides[case].peak, "MiB")
    figures.add(recurrence, "teaching", chain.taught.metric("teach_seconds"), "s")
    _add_errors(
        figures, {case: side for case, side in sides.items() if not case.name.endswith(_PARTS)}, truth
    )
    _add_ratios(figures, recurrence, times)


def _reduced(chain: Pipeline, case: Case, figures: Measurements) -> dict[str, WholeRun]:
    """The run by recurrence, and parts of it by the ends of their names; adds memory and the first frame."""
    device, manifold = figures.settings.device, chain.manifold()
    solver, peak = build(partial(chain.solver_at, manifold, chain.held_out[0]), device)
    at = manifold.restrict(dtype=torch.float32, device=device)
    figures.add(case, "peak memory", peak, "MiB")
    figures.add(case, "memory of a run", solver.nbytes / 2**20, "MiB")
    figures.add(case, "memory of decoding", at.nbytes / 2**20, "MiB")
    figures.add(case, "first frame", _ready_seconds(chain, device), "s")
    tolerance = _HIDDEN * min(chain.taught.metric("errors", kind=[float]))
    whole = Decoded(solver, at, tolerance, calibrated(chain, manifold))
    parts = Decoded(solver, at, tolerance), WholeRun(solver, solver.total_steps)
    return {"": whole, **dict(zip(_PARTS, parts, strict=True))}


def _ready_seconds(chain: Pipeline, device: str) -> float:
    """Time [s] from the files of a deployed model to the first decoded frame, nothing compiled anew."""
    fresh = Pipeline(chain.config, say=lambda line: None, root=chain.root)

    def first_frame() -> None:
        manifold = fresh.manifold()
        run = fresh.solver_at(manifold, fresh.held_out[0])
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
        if case.name.startswith("full_order"):
            continue
        if isinstance(side, Decoded):
            off = torch.stack(side.positions_after(steps.tolist())) - x
            figures.add(case, "error bar", side.verdict.bound_share, "1")
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
    decoded, size = float(np.median(times[recurrence])), recurrence.name.removeprefix("recurrence")
    for case, ms in times.items():
        if case != recurrence:
            what = f"{case.name.replace(size, '').replace('_', ' ')} {case.precision}"
            ratio = figures.add(recurrence, f"time of {what} over it", float(np.median(ms)) / decoded, "1")
            figures.say(f"{recurrence.name}: {decoded:.4g} ms; {what}: {ratio:.4g} times")
