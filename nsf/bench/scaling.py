"""How a step of both solvers grows with the number of particles, and the reduced one with that of samples."""

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
import torch

from nsf import config
from nsf.bench.full_order import kernel_rows
from nsf.bench.measure import bandwidth, build, name_of, window_times
from nsf.bench.reduced import scale_of
from nsf.bench.rows import Result, Row, Settings, commit, size_name
from nsf.data import hash_of_positions
from nsf.dynamics import ReducedMPM
from nsf.evaluation import metrics
from nsf.evaluation.superresolution import POINTS
from nsf.kinematics.fields.basis import BasisManifold
from nsf.kinematics.interpolation import interpolation, lying_together
from nsf.mpm import FullOrderMPM
from nsf.pipeline import Pipeline
from nsf.scenes import Scene
from nsf.vectors import spaced

SIZES = {
    "cuda": (10_000, 30_000, 100_000, 300_000, 1_000_000, 2_000_000, 4_000_000),
    "cpu": (2_500, 5_000, 10_000, 20_000),
}
SAMPLES = (15, 50, 150, 500, 1000)
_SAMPLE = 20  # |S| while P grows
_FRAMES = 5  # at which δ is taken, evenly spread over the run


def run(settings: Settings, found: Result, say: Callable[[str], object]) -> None:
    """The sand column: from 10 000 to 4 million particles on a GPU, to 20 000 on a CPU.

    The fields are trained once, at the paper's size on a GPU and at small scale on a CPU, and evaluated
    between their particles at all other numbers, where the dynamics run on them with another Δx and Δt: how
    far that goes, δ tells. Data and training are made, or reused, as by `nsf train`.
    """
    kind = "cuda" if settings.device.startswith("cuda") else "cpu"
    overrides = ["scene=sand", f"scale={scale_of(settings.device)}", f"device={settings.device}"]
    chain = Pipeline(config.load(overrides), say=say)
    measured(chain, settings.particles or SIZES[kind], SAMPLES, settings, found, say)


def measured(
    chain: Pipeline, sizes: Sequence[int], samples: Sequence[int], settings: Settings, found: Result, say
) -> None:
    """Add the rows of one scene with `field=basis`, in its first held-out case.

    Args:
        chain: of the scene.
        sizes: numbers of particles P, all at one |S|.
        samples: numbers of samples |S|, all at the scene's own P.
        settings: precisions, device and trials.
        found: gets the rows.
        say: told of every result.
    """
    if not chain.training.complete:
        chain.simulate(("train",))
    chain.train()
    manifold, speed = chain.manifold(), bandwidth(settings.device)
    for particles in sizes:
        if particles != len(manifold.X):  # measured below
            scene = at_size(chain.scene, particles)
            fields = partial(carried_over, manifold, scene, settings.device)
            _compared(chain, scene, fields, (_SAMPLE,), settings, speed, found, say)
    _compared(chain, chain.scene, lambda: manifold, samples, settings, speed, found, say)


def at_size(scene: Scene, particles: int) -> Scene:
    """The same body of that many particles, on a grid about as much finer, and in steps as much shorter.

    The floor lies as far from the nodes next to it, in cells: what it holds depends on that.
    """
    ratio, (floor,) = (particles / len(scene.particles())) ** (1 / 3), scene.colliders
    cells = floor.point[2] / scene.dx
    ratio = 1.0 + round((ratio - 1.0) * cells) / cells
    template = scene.resampled(particles).template.copy()
    template.scene.dx, template.scene.dt = scene.dx / ratio, scene.dt / ratio
    template.scene.steps = round(scene.steps * ratio)
    return Scene.from_config(template)


@torch.no_grad()
def carried_over(manifold: BasisManifold, scene: Scene, device: str) -> BasisManifold:
    """The same fields and latent space on another number of particles of the same body, on the device.

    Its encoder is of no use: modes that are orthonormal over some particles are not over others. The manifold
    given is moved to the device.
    """
    X = torch.as_tensor(scene.particles().X, device=device)
    state = dict(manifold.to(device).state_dict(), X=X)
    tables = {name: values for name, values in state.items() if name.endswith((".mean", ".modes"))}
    tables = {name: values for name, values in tables.items() if len(values) == len(manifold.X)}
    state |= {name: values.new_empty(len(X), *values.shape[1:]) for name, values in tables.items()}
    for rows in lying_together(X, POINTS):
        at_rows = interpolation(X[rows], manifold.X)
        for name, values in tables.items():
            state[name][rows] = at_rows.value(values).to(values)
    with torch.device("meta"):
        found = BasisManifold(
            manifold.latent_dim,
            hash_of_positions(scene.particles().X),
            list(manifold.parameter_names),
            manifold.hyperparameters | {"particles": len(X)},
        )
    found.load_state_dict(state, assign=True)
    return found.requires_grad_(False).eval()


def _compared(
    chain: Pipeline,
    scene: Scene,
    fields: Callable[[], BasisManifold],
    samples: Sequence[int],
    settings: Settings,
    speed: float,
    found: Result,
    say: Callable[[str], object],
) -> None:
    """Add both solvers of a scene in every precision, all in turns; nothing of them stays on the device."""
    device, scene = settings.device, scene.with_parameters(chain.held_out[0])
    built = _built(chain, scene, fields(), samples, settings)
    times = window_times(
        {of: solver for of, (solver, _) in built.items()}, scene.steps, settings.trials, device
    )
    steps = frames_of(scene.steps)
    truth = positions_after(scene.full_order(precision=max(settings.precisions), device=device), steps)
    for (case, precision), (solver, peak_mib) in built.items():
        reduced = isinstance(solver, ReducedMPM)
        delta = _error(solver, steps, truth) if reduced else None
        p10, median, p90 = np.percentile(times[case, precision], [10, 50, 90]).tolist()
        row = Row(
            bench="scaling", case=case, particles=len(truth[0]), batch=1, precision=precision, delta=delta,
            sample=solver.sample_size if reduced else None, device=name_of(device), ms_median=median,
            integration=round(solver.integration_mean) if reduced else None, ms_p10=p10, ms_p90=p90,
            peak_mib=peak_mib, commit=commit(),
        )  # fmt: skip
        found.rows.append(row)
        say(f"{case} {precision}: {median:.4g} ms a step" + (f", δ {100 * delta:.3g} %" if reduced else ""))
        if not reduced:
            found.kernels.extend(kernel_rows("scaling", case, precision, solver, speed))


def _built(
    chain: Pipeline, scene: Scene, fields: BasisManifold, samples: Sequence[int], settings: Settings
) -> dict[tuple[str, str], tuple[FullOrderMPM | ReducedMPM, float]]:
    """By case and precision, each solver after its warm-up and the most memory it took [MiB]."""
    device, size = settings.device, size_name(len(fields.X))
    found = {
        (f"full_order_{size}", p): build(partial(scene.full_order, precision=p, device=device), device)
        for p in settings.precisions
    }
    rest = torch.as_tensor(chain.scene.particles().X)
    xhat = chain.manifold().encode(rest[None])[0].numpy()
    make = partial(
        scene.reduced, fields, chain.held_out[0], sources=chain.sources, device=device,
        projector=chain.projector, integration=chain.integration, xhat=xhat,
    )  # fmt: skip
    for number in samples:
        case = f"reduced_{size}" if len(samples) == 1 else f"reduced_{size}_s{number}"
        first = make(sample=number)
        how = {"sample": first.samples, "sets": first.sets}
        del first  # its arrays are on the device
        for p in settings.precisions:
            found[case, p] = build(partial(make, **how, precision=p), device)
    return found


def frames_of(steps: int) -> np.ndarray:
    """Steps after which δ is taken, of a run of so many."""
    return spaced(steps + 1, _FRAMES + 1)[1:]


def positions_after(solver: FullOrderMPM, steps: Sequence[int]) -> list[torch.Tensor]:
    """[P, 3] positions [m] after some numbers of steps, on the host."""
    found = []
    for step in steps:
        solver.step(int(step) - solver.steps_taken)
        found.append(torch.as_tensor(solver.state.x.numpy()))
    return found


@torch.no_grad()
def _error(solver: ReducedMPM, steps: Sequence[int], truth: Sequence[torch.Tensor]) -> float:
    """δ of a whole run against positions after some of its steps; ∞ if it diverged."""
    solver.restart()
    solver.step(solver.total_steps)
    if solver.left_grid() >= 0:
        return float("inf")
    decoder, errors, norms = solver.decoder(), [], []
    for step, x in zip(steps, truth, strict=True):
        x = x.to(decoder.at.device, decoder.at.dtype)[None]
        errors.append(metrics.frame_squares(decoder.position(solver.record.xhat[step])[None] - x))
        norms.append(metrics.frame_squares(x))
    return metrics.relative(torch.cat(errors), torch.cat(norms))
