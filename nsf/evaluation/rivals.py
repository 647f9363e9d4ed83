"""Rivals of a reduced run: two that need no dynamics, and the full-order solver on a coarser grid.

On a family with few parameters and a fixed forcing, interpolating the training runs can be as near to the
truth as a reduced run, and costs nothing. Whoever reads an error should see these beside it.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from nsf.data import Trajectory
from nsf.dynamics import ReducedMPM
from nsf.errors import InstabilityError, NSFError
from nsf.evaluation import metrics
from nsf.evaluation.cost import Subject
from nsf.kinematics.blocks import frames_at_once
from nsf.kinematics.interpolation import interpolation
from nsf.models import TrainingRuns
from nsf.mpm.stability import largest_stable_dt
from nsf.scenes import Scene

_VALUES = 18  # of a particle and frame that are held together: the truth, and six distances from it
_WHOLE = 1e-9  # of a step, by which a time may lie before it


def forcing_of(scene: Scene) -> np.ndarray:
    """[D] what forces a run in its course: gravity, and the solids' shifts, at each step.

    Gravity in units of its reach and shifts in Δx, so that they can be held side by side.
    """
    acting, parts = scene.forcing_at(scene.dt * np.arange(scene.steps)), []
    if scene.forcing.gravity:
        parts.append(
            acting["gravity"].ravel() / (scene.forcing.reach(scene.base_gravity, scene.duration) or 1.0)
        )
    moved = [name in scene.forcing.colliders for name in scene.colliders]
    parts.append(acting["solids"][:, moved, :3].ravel() / scene.dx)
    return np.concatenate(parts)


@dataclass(frozen=True)
class CoarseRun:
    """The full-order solver on a grid `factor` times as coarse, with as many particles a cell.

    Attributes:
        x: [F, P, 3] positions [m] of the fine particles at the fine frames; displacements are interpolated
            at rest.
        steps: taken; dx: its grid spacing [m]; particles: its own.
    """

    x: np.ndarray
    steps: int
    dx: float
    particles: int


def coarse_scene(scene: Scene, parameters: Mapping[str, float], factor: int) -> Scene:
    """A scene at parameter values on a coarser grid.

    Δt is the largest whole multiple of the scene's that is stable and divides its steps.

    Raises:
        ConfigError: a solid, a collider or the walls do not fit the coarse grid.
        InstabilityError: the scene's Δt is unstable on it.
    """
    fine = scene.at(parameters)
    coarse = fine.coarsened(factor)
    stable = largest_stable_dt(coarse.particles(), coarse.initial_velocity(), coarse.dx)
    multiples = [m for m in range(1, factor + 1) if scene.steps % m == 0 and m * scene.dt <= stable]
    if not multiples:
        raise InstabilityError(f"dt={scene.dt:g} s is unstable at dx={coarse.dx:g} m")
    return fine.coarsened(factor, multiples[-1])


def coarse_run(
    scene: Scene,
    parameters: Mapping[str, float],
    X: np.ndarray,
    t: np.ndarray,
    factor: int,
    precision: str,
    device: str,
    advance: Callable[[int], object] = lambda frames: None,
) -> CoarseRun | str:
    """Run a scene on a coarser grid, and carry its displacements to the scene's own particles.

    Args:
        scene: the fine one.
        parameters: problem parameters by name.
        X: [P, 3] reference positions of the fine particles [m].
        t: [F] times of the fine frames [s], ascending.
        factor: of Δx; particles become fewer by its third power.
        precision: `fp64` or `fp32`.
        device: `cpu`, `cuda` or `cuda:N`.
        advance: told how many frames more there are; of all of them where there is no run.

    Returns:
        The run; or the reason why there is none, such as a solid that the coarse grid does not resolve.
    """
    left = len(t)  # frames
    try:
        coarse = coarse_scene(scene, parameters, factor)
        solver = coarse.full_order(precision=precision, device=device)
        particles = torch.as_tensor(coarse.particles().X)
        carried = interpolation(torch.as_tensor(X), particles)

        def moved() -> np.ndarray:
            return carried.value(torch.as_tensor(solver.state.numpy()["x"]) - particles).numpy()

        at = t * (coarse.steps / (scene.steps * scene.dt))
        below = np.minimum((at + _WHOLE).astype(int), coarse.steps - 1)
        x, ahead, taken = np.empty((len(at), *X.shape)), moved(), 0
        for frame, share in enumerate(at - below):
            if taken <= below[frame]:
                if taken < below[frame]:
                    solver.step(int(below[frame]) - taken)
                    ahead = moved()
                last = ahead
                solver.step(1)
                ahead, taken = moved(), int(below[frame]) + 1
            x[frame] = X + (1.0 - share) * last + share * ahead
            left -= 1
            advance(1)
    except NSFError as error:
        advance(left)
        return str(error)
    return CoarseRun(x=x, steps=coarse.steps, dx=coarse.dx, particles=len(particles))


@dataclass(frozen=True)
class Rivals:
    """How far the rivals of a reduced run are from its truth, as `displacement_error` over frames 1..N.

    Where programs force the runs, these count among the parameters.

    Attributes:
        static: nothing moves, which is 1 by definition; nearest: the training run of the nearest parameters,
            by its latent vectors; interpolated: the latent vectors of training runs, interpolated over the
            parameters.
        coarse: of the full-order solver by factor of Δx: `displacement_error`, `dx` [m], `particles` and
            `steps`; or `why` there is none.
    """

    static: float
    nearest: float
    interpolated: float
    coarse: dict[int, dict]

    @property
    def factors(self) -> list[int]:
        """The factors of Δx at which there is a coarse run."""
        return [factor for factor, run in self.coarse.items() if "why" not in run]


def rivals(
    solver: ReducedMPM,
    trajectory: Trajectory,
    factors: Sequence[int] = (),
    training: Sequence[Scene] = (),
    advance: Callable[[int], object] = lambda frames: None,
) -> Rivals:
    """Hold the rivals of a reduced run to its full-order trajectory, at all particles and frames.

    Args:
        solver: the reduced solver of the run, with the training runs' latent vectors in its manifold.
        trajectory: the full-order run; its frames are those of the training runs.
        factors: of Δx of coarse full-order runs.
        training: the scene in each training case, in order; read where programs force the runs.
        advance: told how many frames more there are of a coarse run, or are compared.
    """
    scene, setup = solver.scene, solver.setup
    forcing = [forcing_of(one) for one in training] if scene.forcing else []
    decoder, runs = solver.decoder(), TrainingRuns.of(solver.manifold, forcing)
    parameters = setup.parameters.cpu().double().numpy()
    if forcing:
        parameters = np.concatenate([parameters, forcing_of(scene)])

    def tensor(values) -> torch.Tensor:
        return torch.as_tensor(np.asarray(values)).to(setup.torch_device).to(setup.dtype)

    latents = {"nearest": tensor(runs.nearest(parameters))}
    latents["interpolated"] = tensor(runs.interpolated(parameters))
    how = setup.precision.name, setup.device, advance
    fine = scene, setup.values, trajectory.X, trajectory.t
    coarse = {factor: coarse_run(*fine, factor, *how) for factor in factors}
    ran = {factor: run for factor, run in coarse.items() if not isinstance(run, str)}
    X, squares = tensor(trajectory.X), {}
    rows = frames_at_once(_VALUES * trajectory.particles, setup.dtype, setup.torch_device)
    for start in range(1, trajectory.frames, rows):
        block = slice(start, min(start + rows, trajectory.frames))
        x = tensor(trajectory.read("x", frames=block))
        differences = {"norm": x - X, "static": X - x}
        differences |= {name: decoder.position(xhat[block]) - x for name, xhat in latents.items()}
        differences |= {factor: tensor(run.x[block]) - x for factor, run in ran.items()}
        for name, apart in differences.items():
            squares.setdefault(name, []).append(metrics.frame_squares(apart))
        advance(len(x))
    norm = torch.cat(squares.pop("norm"))
    errors = {name: metrics.relative(torch.cat(of), norm) for name, of in squares.items()}
    coarse_runs = {
        factor: {"why": run}
        if isinstance(run, str)
        else {
            "displacement_error": errors.pop(factor),
            "dx": run.dx,
            "particles": run.particles,
            "steps": run.steps,
        }
        for factor, run in coarse.items()
    }
    return Rivals(**errors, coarse=coarse_runs)


def coarse_subjects(
    scene: Scene, parameters: Mapping[str, float], factors: Sequence[int], precision: str, device: str
) -> dict[str, Subject]:
    """Coarse full-order runs to be timed beside others, by `coarse_factor`; each factor must have a run."""

    def subject(coarse: Scene) -> Subject:
        return Subject(lambda: coarse.full_order(precision=precision, device=device), coarse.steps)

    return {f"coarse_{factor}": subject(coarse_scene(scene, parameters, factor)) for factor in factors}
