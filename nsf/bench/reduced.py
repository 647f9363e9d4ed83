"""A reduced step beside the full-order one, on the paper's cake and metal, and what a longer Δt costs."""

import itertools
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from nsf import config, engines
from nsf.bench.command import SCENES
from nsf.bench.full_order import add_pass
from nsf.bench.measure import bandwidth, launch_time
from nsf.bench.rows import Case, Measurements
from nsf.data import Trajectory
from nsf.data.schema import TRAJECTORY
from nsf.dynamics.setup import reduced_steps
from nsf.evaluation import metrics
from nsf.evaluation.cost import SolverCost, Subject, measure
from nsf.kinematics.fields.networks import ARITHMETIC
from nsf.pipeline import Pipeline
from nsf.vectors import at_times

#: How sample particles are chosen in another case of a scene, beside the scene's own way.
OTHER_SAMPLER = {"cake": "region", "metal": "cells"}
#: Steps of the deployment in units of the scene's Δt (paper section 6.1 has 1.5 on cake).
MULTIPLIERS = (1.5, 2.0, 3.0)
#: Trials of networks at most, and steps of one: theirs cost alike from the first to the last.
_MOST, _FEW = 3, 200
#: Passes of a step each of which needs the one before it: x and v at S, those of the particles that its nodes
#: need, their τ and C, P2G, G2P, what the projection takes from S, and its solution.
_DEPENDENT = 7

Frames = Iterable[tuple[float, Tensor]]
"""Time [s] and positions [P, 3] [m] of full-order frames after the first."""


def run(figures: Measurements) -> None:
    """Each scene: at the paper's size on a GPU, at small scale on a CPU.

    Data and training are made, or reused, as by `nsf train`. A step of k Δt stands in the case's name; it
    moves the scene by k times as much as the others. The name of a sampler there is how sample particles are
    chosen, else in the scene's own way. With field=mlp it names what multiplies the hidden layers of h and
    l: tf32 or bf16 on tensor cores, or nothing where they are in the precision of the step.
    """
    for scene in scenes(figures):
        measured(dict(_by_sampler(scene, figures)), figures)
        measured_networks(_pipeline(scene, figures, "field=mlp"), figures)


def scenes(figures: Measurements) -> list[str]:
    """The scenes of reduced steps that are measured."""
    return [scene for scene in figures.settings.scenes or SCENES if scene in SCENES]


def pipelines(figures: Measurements, samplers: bool = False) -> Iterator[tuple[str, Pipeline]]:
    """The configuration of each scene, after the end of its cases; with another sampler too where asked."""
    for scene in scenes(figures):
        yield from itertools.islice(_by_sampler(scene, figures), 1 + samplers)


def _by_sampler(scene: str, figures: Measurements) -> Iterator[tuple[str, Pipeline]]:
    yield "", _pipeline(scene, figures)
    other = OTHER_SAMPLER[scene]
    yield f"_{other}", _pipeline(scene, figures, f"sampler={other}")


def _pipeline(scene: str, figures: Measurements, *overrides: str) -> Pipeline:
    keys = f"scene={scene}", f"scale={figures.settings.scale}", f"device={figures.settings.device}"
    return Pipeline(config.load([*keys, *overrides]), say=figures.say)


def prepared(chain: Pipeline) -> tuple[object, Path, dict]:
    """Manifold, full-order trajectory and options of reduced runs in the first held-out case."""
    chain.simulate(("train",))
    chain.train()
    manifold = chain.manifold()
    first = chain.solver_at(manifold, chain.held_out[0])
    options = {"sample": first.samples, "sets": first.sets, "sources": chain.sources}
    options |= {"projector": chain.projector, "integration": chain.integration}
    return manifold, chain.truth(chain.held_out[0]).path / TRAJECTORY, options


def measured(chains: Mapping[str, Pipeline], figures: Measurements) -> None:
    """Add the rows of one scene in its first held-out case; every side of a precision turn by turn.

    Args:
        chains: by the end of a case's name, configurations that differ in the sampler alone; longer steps are
            those of the first.
        figures: see `run`.
    """
    chain, device = chains[""], figures.settings.device
    scene, first, name = chain.scene, chain.held_out[0], chain.scene.name
    ready = {end: prepared(one) for end, one in chains.items()}
    manifold, truth, _ = ready[""]
    speed, launches = bandwidth(device), launch_time(device, _DEPENDENT)

    def reduced(precision: str, multiplier: float, end: str = ""):
        how = ready[end][2] | {"precision": precision, "device": device}
        return engines.reduced(scene, manifold, first, dt_multiplier=multiplier, **how)

    for precision in figures.settings.precisions:
        full = Subject(partial(scene.full_order, first, precision, device), scene.steps)
        subjects = {f"full_order_{name}": full}
        for end in chains:
            subjects[f"reduced_{name}{end}"] = Subject(partial(reduced, precision, 1.0, end), scene.steps)
        whole = list(subjects)
        for k in MULTIPLIERS:
            steps = reduced_steps(scene.steps, k)
            subjects[f"reduced_{name}_{k:g}dt"] = Subject(partial(reduced, precision, k), steps)
        for side, cost in measure(subjects, figures.settings.trials, device).items():
            solver = _at_end(subjects[side]) if side.startswith("reduced_") else None
            case = _add(figures, side, precision, len(manifold.X), cost, solver, truth)
            if side not in whole:
                continue
            for stage, ms in cost.stages.items():
                figures.add(case, "stage", ms, part=stage)
            if solver:
                _add_floors(figures, case, solver, cost.stages, speed, launches)


def measured_networks(chain: Pipeline, figures: Measurements) -> None:
    """Add the rows of one scene with field=mlp, likewise, in each arithmetic of the networks.

    A step's time is that of the first ones of a run, δ that of a whole one. A CPU has no tensor cores.
    """
    settings, name = figures.settings, chain.scene.name
    manifold, truth, how = prepared(chain)

    def reduced(arithmetic: str | None, precision: str):
        manifold.arithmetic = arithmetic
        how.update(precision=precision, device=settings.device)
        return engines.reduced(chain.scene, manifold, chain.held_out[0], **how)

    for precision in settings.precisions:
        subjects = {}
        for arithmetic in (None, *ARITHMETIC) if settings.on_gpu else (None,):
            side = f"reduced_{name}_mlp" + (f"_{arithmetic}" if arithmetic else "")
            subjects[side] = Subject(partial(reduced, arithmetic, precision), min(chain.scene.steps, _FEW))
        for side, cost in measure(subjects, min(settings.trials, _MOST), settings.device).items():
            _add(figures, side, precision, len(manifold.X), cost, _at_end(subjects[side]), truth)


def _at_end(subject: Subject):
    solver = subject.build()
    solver.step(solver.total_steps)
    return solver


def _add(
    figures: Measurements, side: str, precision: str, particles: int, cost: SolverCost, solver, truth: Path
) -> Case:
    """Add a side's time, memory and, of a reduced run at its end, δ."""
    sizes = {}
    if solver:
        sizes = {"sample": solver.sample_size, "integration": round(solver.integration_mean)}
    case = Case(bench="reduced", name=side, particles=particles, precision=precision, **sizes)
    figures.add(case, "step", cost.step_ms, quantiles=(cost.step_ms_p10, cost.step_ms_p90))
    figures.add(case, "peak memory", cost.memory_mib, "MiB")
    error = ""
    if solver:
        error = f", δ {100 * figures.add(case, 'δ', deformation_error(solver, truth), '1'):.3g} %"
    figures.say(f"{side} {precision}: {cost.step_ms:.4g} ms a step{error}")
    return case


def _add_floors(
    figures: Measurements, case: Case, solver, stages: Mapping[str, float], speed: float, launches: float
) -> None:
    """Add what bounds a reduced step: its largest passes over memory, if no cache holds that, and launches.

    Where samples change in a run, as cake's region does, modes are those of the last span and nodes of the
    first.

    Args:
        figures, case: of the step.
        solver: a `ReducedMPM` that has taken its steps.
        stages: time of each stage [ms].
        speed: of a copy [B/s].
        launches: of as many empty launches as a step has passes that wait for each other [ms].
    """
    N, nodes = case.integration, len(solver.sets[0].nodes)
    real = np.dtype(solver.setup.precision.numpy).itemsize
    moved = {
        "inference": N * (solver.span.mode_bytes + 24 * real),  # the modes; x, v, C, τ
        "p2g": real * (26 * N + 8 * nodes),  # x, v, C, τ, m, V; the nodes, there and back
    }
    for part, size in moved.items():
        add_pass(figures, case, part, stages[part], size, 1e3 * size / speed)
    add_pass(figures, case, f"{_DEPENDENT} empty launches", launches, 0.0, launches)


def deformation_error(solver, truth: Path | Frames) -> float:
    """δ of a reduced run that has ended; ∞ for one that diverged.

    Args:
        solver: the run.
        truth: file of the full-order trajectory, or its frames.
    """
    if solver.left_grid() >= 0:
        return float("inf")
    run = solver.trajectory()
    return error_of_latents(run.t, run.xhat, solver.decoder().position, truth, solver.xhat)


@torch.no_grad()
def error_of_latents(
    t: np.ndarray, xhat, position: Callable[[Tensor], Tensor], truth: Path | Frames, like: Tensor
) -> float:
    """δ of latent vectors over full-order frames; between its steps a run counts by the latents between them.

    Args:
        t: [N + 1] their times [s].
        xhat: [N + 1, r] of them.
        position: x̂ [r] → [P, 3] [m]; truth: as for `deformation_error`.
        like: a tensor of the precision and device of `position`.
    """
    rows, errors, norms = torch.as_tensor(xhat).cpu().numpy(), [], []
    for at, x in _frames(truth) if isinstance(truth, Path) else truth:
        now = torch.as_tensor(at_times(at, t, rows)).to(like)
        errors.append(metrics.frame_squares((position(now) - x.to(like))[None]))
        norms.append(metrics.frame_squares(x.to(like)[None]))
    return metrics.relative(torch.cat(errors), torch.cat(norms))


def _frames(truth: Path) -> Iterator[tuple[float, Tensor]]:
    with Trajectory.open(truth) as trajectory:
        for frame in range(1, trajectory.frames):
            x = trajectory.read("x", frames=[frame])[0]
            yield float(trajectory.t[frame]), torch.as_tensor(np.asarray(x))
