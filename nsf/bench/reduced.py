"""A reduced step beside the full-order one, on the paper's cake and metal, and what a longer Δt costs."""

from collections.abc import Callable, Mapping
from functools import partial

import numpy as np
import torch

from nsf import config
from nsf.bench.measure import bandwidth, launch_time, name_of
from nsf.bench.rows import OTHER_SAMPLER, KernelRow, Result, Row, Settings, StageRow, commit
from nsf.data import Trajectory
from nsf.data.schema import TRAJECTORY
from nsf.dynamics.setup import reduced_steps
from nsf.evaluation import metrics
from nsf.evaluation.cost import SolverCost, Subject, measure
from nsf.kinematics.fields.networks import ARITHMETIC
from nsf.pipeline import Pipeline

SCENES = ("cake", "metal")
#: Steps of the deployment in units of the scene's Δt (paper section 6.1 has 1.5 on cake).
MULTIPLIERS = (1.5, 2.0, 3.0)
#: Of the networks of stress and affine momentum with field=mlp; a CPU has no tensor cores.
ARITHMETICS = {"cuda": (None, *ARITHMETIC), "cpu": (None,)}
#: Trials of networks at most, and steps of one: theirs cost alike from the first to the last.
_MOST, _FEW = 3, 200
_CHUNK = 2**26  # positions decoded at once
#: Passes of a step each of which needs the one before it: x and v at S, those of the particles that its nodes
#: need, their τ and C, P2G, G2P, what the projection takes from S, and its solution.
_DEPENDENT = 7


def run(settings: Settings, found: Result, say: Callable[[str], object]) -> None:
    """Each scene: at the paper's size on a GPU, at small scale on a CPU.

    Data and training are made, or reused, as by `nsf train`. A step of k Δt stands in the case's name; it
    moves the scene by k times as much as the others. The name of a sampler there is how sample particles are
    chosen, else in the scene's own way. With field=mlp it names what multiplies the hidden layers of h and
    l: tf32 or bf16 on tensor cores, or nothing where they are in the precision of the step.
    """
    for scene in settings.scenes or SCENES:
        scale = scale_of(settings.device)
        overrides = [f"scene={scene}", f"scale={scale}", f"device={settings.device}"]
        chains = {
            end: Pipeline(config.load([*overrides, *own]), say=say) for end, own in samplers(scene).items()
        }
        measured(chains, settings, found, say)
        networks = config.load([*overrides, "field=mlp"])
        measured_networks(Pipeline(networks, say=say), settings, found, say)


def samplers(scene: str) -> dict[str, tuple[str, ...]]:
    """The end of a case's name, and the overrides by which its sample particles are chosen."""
    other = OTHER_SAMPLER[scene]
    return {"": (), f"_{other}": (f"sampler={other}",)}


def scale_of(device: str) -> str:
    """The size of the scenes that a device can be asked for: the paper's, or small."""
    return "paper" if device.startswith("cuda") else "small"


def measured(
    chains: Mapping[str, Pipeline], settings: Settings, found: Result, say: Callable[[str], object]
) -> None:
    """Add the rows of one scene in its first held-out case; every side of a precision turn by turn.

    Args:
        chains: by the end of a case's name, configurations that differ in the sampler alone; longer steps are
            those of the first.
        settings, found, say: as for `run`.
    """
    chain = next(iter(chains.values()))
    chain.simulate(("train",))
    chain.train()
    manifold, scene, first = chain.manifold(), chain.scene, chain.held_out[0]
    name = scene.name
    built = {end: one.solver_at(manifold, first) for end, one in chains.items()}
    sets = {end: (solver.samples, solver.sets) for end, solver in built.items()}
    del built  # their arrays are on the device
    truth = chain.truth(first).path / TRAJECTORY
    speed, launches = bandwidth(settings.device), launch_time(settings.device, _DEPENDENT)

    def reduced(precision: str, multiplier: float, end: str = ""):
        samples, own = sets[end]
        return scene.reduced(
            manifold, first, samples, sets=own, sources=chain.sources, projector=chain.projector,
            integration=chain.integration, precision=precision, device=settings.device,
            dt_multiplier=multiplier,
        )  # fmt: skip

    for precision in settings.precisions:
        subjects = {
            f"full_order_{name}": Subject(
                lambda p=precision: scene.full_order(first, p, settings.device), scene.steps
            )
        }
        for end in chains:
            subjects[f"reduced_{name}{end}"] = Subject(partial(reduced, precision, 1.0, end), scene.steps)
        for k in MULTIPLIERS:
            subjects[f"reduced_{name}_{k:g}dt"] = Subject(
                partial(reduced, precision, k), reduced_steps(scene.steps, k)
            )
        for case, cost in measure(subjects, settings.trials, settings.device).items():
            solver = None
            if case.startswith("reduced_"):
                solver = subjects[case].build()
                solver.step(solver.total_steps)
            row = _row(case, len(scene.particles()), precision, settings.device, cost, solver, truth)
            found.rows.append(row)
            if case in (f"full_order_{name}", *(f"reduced_{name}{end}" for end in chains)):
                found.stages.extend(
                    StageRow(row.bench, case, row.particles, precision, row.device, stage, ms, row.commit)
                    for stage, ms in cost.stages.items()
                )
                if solver:
                    found.kernels.extend(floors(row, solver, cost.stages, speed, launches))
            error = "" if row.delta is None else f", δ {100 * row.delta:.3g} %"
            say(f"{case} {precision}: {row.ms_median:.4g} ms a step{error}")


def floors(row: Row, solver, stages: Mapping[str, float], speed: float, launches: float) -> list[KernelRow]:
    """What bounds a reduced step: its largest passes over memory, if no cache holds that, and empty launches.

    Where samples change in a run, as cake's region does, modes are those of the last span and nodes of the
    first.

    Args:
        row: of the step.
        solver: a `ReducedMPM` that has taken its steps.
        stages: time of each stage [ms].
        speed: of a copy [B/s].
        launches: what as many launches of nothing as a step has passes that wait for each other take [ms].
    """
    N, nodes = row.integration, len(solver.sets[0].nodes)
    real = np.dtype(solver.setup.precision.numpy).itemsize
    moved = {
        "inference": N * (solver.span.mode_bytes + 24 * real),  # the modes; x, v, C, τ
        "p2g": real * (26 * N + 8 * nodes),  # x, v, C, τ, m, V; the nodes, there and back
    }
    found = {name: (stages[name], size, 1e3 * size / speed) for name, size in moved.items()}
    found[f"{_DEPENDENT} empty launches"] = launches, 0.0, launches
    return [
        KernelRow(
            bench=row.bench, case=row.case, particles=row.particles, precision=row.precision, kernel=name,
            ms=ms, device=row.device, mib=size / 2**20, gb_per_s=size / ms / 1e6, floor_ms=floor,
            commit=row.commit,
        )
        for name, (ms, size, floor) in found.items()
    ]  # fmt: skip


def measured_networks(
    chain: Pipeline, settings: Settings, found: Result, say: Callable[[str], object]
) -> None:
    """Add the rows of one scene with field=mlp, likewise, in each arithmetic of the networks.

    A step's time is that of the first ones of a run, δ that of a whole one.
    """
    chain.simulate(("train",))
    chain.train()
    manifold, case, name = chain.manifold(), chain.held_out[0], chain.scene.name
    truth, particles = chain.truth(case).path / TRAJECTORY, len(manifold.X)
    first = chain.solver_at(manifold, case)
    options = {"sample": first.samples, "sets": first.sets, "device": settings.device}
    options["sources"] = chain.sources
    options |= {"projector": chain.projector, "integration": chain.integration}
    del first  # its arrays are on the device
    kind = "cuda" if settings.device.startswith("cuda") else "cpu"

    def reduced(arithmetic: str | None, precision: str):
        manifold.arithmetic = arithmetic
        return chain.scene.reduced(manifold, case, precision=precision, **options)

    for precision in settings.precisions:
        subjects = {
            f"reduced_{name}_mlp" + (f"_{arithmetic}" if arithmetic else ""): Subject(
                partial(reduced, arithmetic, precision), min(chain.scene.steps, _FEW)
            )
            for arithmetic in ARITHMETICS[kind]
        }
        for row, cost in measure(subjects, min(settings.trials, _MOST), settings.device).items():
            solver = subjects[row].build()
            solver.step(solver.total_steps)
            found.rows.append(_row(row, particles, precision, settings.device, cost, solver, truth))
            say(f"{row} {precision}: {cost.step_ms:.4g} ms a step, δ {100 * found.rows[-1].delta:.3g} %")


def _row(case, particles: int, precision: str, device: str, cost: SolverCost, solver, truth) -> Row:
    return Row(
        bench="reduced", case=case, particles=particles, batch=1, precision=precision,
        sample=solver and solver.sample_size,
        integration=solver and round(solver.integration_mean),
        delta=solver and deformation_error(solver, truth),
        device=name_of(device), ms_median=cost.step_ms, ms_p10=cost.step_ms_p10, ms_p90=cost.step_ms_p90,
        peak_mib=cost.memory_mib, commit=commit(),
    )  # fmt: skip


def deformation_error(solver, truth) -> float:
    """δ of a reduced run that has ended; ∞ for one that diverged. Arguments as for `error_of_latents`."""
    if solver.left_grid() >= 0:
        return float("inf")
    run = solver.trajectory()
    return error_of_latents(run.t, run.xhat, solver.decoder(), truth)


@torch.no_grad()
def error_of_latents(t: np.ndarray, xhat, decoder, truth) -> float:
    """δ of latent vectors over the frames of a trajectory file after the first.

    Between its steps a run of longer Δt counts by the latents between them.

    Args:
        t: [N + 1] their times [s].
        xhat: [N + 1, r] of them.
        decoder: the fields at every particle.
        truth: the file.
    """
    columns = torch.as_tensor(xhat).cpu().numpy().T
    with Trajectory.open(truth) as trajectory:
        frames = trajectory.frames
        between = np.stack([np.interp(trajectory.t, t, column) for column in columns], axis=1)
        xhat = torch.as_tensor(between, dtype=decoder.at.dtype, device=decoder.at.device)
        rows = max(1, _CHUNK // (3 * trajectory.particles))
        errors, norms = [], []
        for start in range(1, frames, rows):
            block = slice(start, min(start + rows, frames))
            x = torch.as_tensor(np.asarray(trajectory.read("x", frames=block))).to(xhat)
            errors.append(metrics.frame_squares(decoder.position(xhat[block]) - x))
            norms.append(metrics.frame_squares(x))
        return metrics.relative(torch.cat(errors), torch.cat(norms))
