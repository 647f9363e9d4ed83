"""How a step of both solvers grows with the number of particles, and the reduced one with that of samples."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import torch

from nsf import config
from nsf.bench.full_order import add_passes
from nsf.bench.measure import bandwidth, build, window_times
from nsf.bench.reduced import deformation_error
from nsf.bench.rows import Case, Measurements, size_name
from nsf.data import hash_of_positions
from nsf.dynamics import ReducedMPM
from nsf.engines import reduced
from nsf.evaluation.superresolution import POINTS
from nsf.kinematics.fields.basis import BasisManifold
from nsf.kinematics.interpolation import interpolation, lying_together
from nsf.mpm import FullOrderMPM, HalfSpace
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


def run(figures: Measurements) -> None:
    """The sand column: from 10 000 to 4 million particles on a GPU, to 20 000 on a CPU.

    The fields are trained once, at the paper's size on a GPU and at small scale on a CPU, and evaluated
    between their particles at all other numbers, where the dynamics run on them with another Δx and Δt: how
    far that goes, δ tells. Data and training are made, or reused, as by `nsf train`.
    """
    settings = figures.settings
    overrides = ["scene=sand", f"scale={settings.scale}", f"device={settings.device}"]
    chain = Pipeline(config.load(overrides), say=figures.say)
    measured(chain, settings.particles or SIZES["cuda" if settings.on_gpu else "cpu"], SAMPLES, figures)


def measured(chain: Pipeline, sizes: Sequence[int], samples: Sequence[int], figures: Measurements) -> None:
    """Add the rows of one scene with `field=basis`, in its first held-out case.

    Args:
        chain: of the scene.
        sizes: numbers of particles P, all at one |S|.
        samples: numbers of samples |S|, all at the scene's own P.
        figures: see `run`.
    """
    if not chain.training.complete:
        chain.simulate(("train",))
    chain.train()
    manifold, speed = chain.manifold(), bandwidth(figures.settings.device)
    for particles in sizes:
        if particles != len(manifold.X):  # measured below
            scene = at_size(chain.scene, particles)
            fields = partial(carried_over, manifold, scene, figures.settings.device)
            _compared(chain, scene, fields, (_SAMPLE,), speed, figures)
    _compared(chain, chain.scene, lambda: manifold, samples, speed, figures)


def at_size(scene: Scene, particles: int) -> Scene:
    """The same body of that many particles, on a grid about as much finer, and in steps as much shorter.

    A floor lies as far from the nodes next to it, in cells: what it holds depends on that. Without one the
    domain keeps a whole number of cells.
    """
    ratio = (particles / scene.particle_count) ** (1 / 3)
    floors = [solid.point[2] for solid in scene.solids if isinstance(solid, HalfSpace)]
    cells = (floors or [scene.size[2]])[0] / scene.dx
    ratio = 1.0 + round((ratio - 1.0) * cells) / cells
    steps = round(scene.steps * ratio)
    return replace(scene.resampled(particles), dx=scene.dx / ratio, dt=scene.dt / ratio, steps=steps)


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
        carried = BasisManifold(
            manifold.latent_dim,
            hash_of_positions(scene.particles().X),
            list(manifold.parameter_names),
            manifold.hyperparameters | {"particles": len(X)},
        )
    carried.load_state_dict(state, assign=True)
    return carried.requires_grad_(False).eval()


def _compared(
    chain: Pipeline,
    scene: Scene,
    fields: Callable[[], BasisManifold],
    samples: Sequence[int],
    speed: float,
    figures: Measurements,
) -> None:
    """Add both solvers of a scene in every precision, all in turns; nothing of them stays on the device."""
    settings, scene = figures.settings, scene.at(chain.held_out[0])
    device = settings.device
    built = _built(chain, scene, fields(), samples, figures)
    solvers = {of: solver for of, (solver, _) in built.items()}
    times = window_times(solvers, scene.steps, settings.trials, device)
    full = scene.full_order(precision=max(settings.precisions), device=device)
    truth = frames_after(full, scene)
    for case, (solver, peak) in built.items():
        ms = figures.add(case, "step", times[case])
        figures.add(case, "peak memory", peak, "MiB")
        if case.sample is None:
            figures.say(f"{case.name} {case.precision}: {ms:.4g} ms a step")
            add_passes(figures, case, solver, speed)
            continue
        solver.restart()
        solver.step(solver.total_steps)
        delta = figures.add(case, "δ", deformation_error(solver, truth), "1")
        figures.say(f"{case.name} {case.precision}: {ms:.4g} ms a step, δ {100 * delta:.3g} %")


def _built(
    chain: Pipeline, scene: Scene, fields: BasisManifold, samples: Sequence[int], figures: Measurements
) -> dict[Case, tuple[FullOrderMPM | ReducedMPM, float]]:
    """Each solver after its warm-up, and the most memory it took [MiB]."""
    device, size, built = figures.settings.device, size_name(len(fields.X)), {}
    of = partial(Case, bench="scaling", particles=len(fields.X))
    for p in figures.settings.precisions:
        case = of(name=f"full_order_{size}", precision=p)
        built[case] = build(partial(scene.full_order, precision=p, device=device), device)
    rest = torch.as_tensor(chain.scene.particles().X)[None]
    xhat = chain.manifold().encode(rest)[0].numpy()
    make = partial(
        reduced, scene, fields, chain.held_out[0], sources=chain.sources, device=device,
        projector=chain.projector, integration=chain.integration, xhat=xhat,
    )  # fmt: skip
    for number in samples:
        name = f"reduced_{size}" if len(samples) == 1 else f"reduced_{size}_s{number}"
        first = make(sample=number)
        how = {"sample": first.samples, "sets": first.sets}
        sizes = {"sample": first.sample_size, "integration": round(first.integration_mean)}
        del first  # its arrays are on the device
        for p in figures.settings.precisions:
            built[of(name=name, precision=p, **sizes)] = build(partial(make, **how, precision=p), device)
    return built


def frames_after(solver: FullOrderMPM, scene: Scene) -> list[tuple[float, torch.Tensor]]:
    """Times [s] and positions [P, 3] [m], on the host, of a few frames that are spread over a run."""
    frames = []
    for step in spaced(scene.steps + 1, _FRAMES + 1)[1:].tolist():
        solver.step(step - solver.steps_taken)
        frames.append((scene.dt * step, torch.as_tensor(solver.state.x.numpy())))
    return frames
