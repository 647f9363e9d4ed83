"""Rivals of a reduced run: two that need no dynamics, and the full-order solver on a coarser grid.

On a family with few parameters and a fixed forcing, interpolating the training runs can be as near to the
truth as a reduced run, and costs nothing. Whoever reads an error should see these beside it.
"""

import time
from dataclasses import dataclass

import numpy as np
import torch
from scipy.interpolate import RBFInterpolator

from nsf.errors import NSFError
from nsf.kinematics.interpolation import interpolation
from nsf.kinematics.manifold import Manifold
from nsf.mpm.stability import largest_stable_dt
from nsf.scenes import Scene
from nsf.timing import synchronizer


@dataclass(frozen=True)
class TrainingRuns:
    """The latent vectors of the training trajectories, run by run.

    Attributes:
        parameters: [K, n] of each run, standardised over the runs; a parameter that never varies is 0.
        latents: [K, F, r] of each frame.
    """

    parameters: np.ndarray
    latents: np.ndarray
    _mean: np.ndarray
    _deviation: np.ndarray

    @classmethod
    def of(cls, manifold: Manifold) -> "TrainingRuns":
        """Those that a manifold was trained on; all have the same frames."""
        run = manifold.training_trajectories.cpu().numpy()
        count = int(run[-1]) + 1
        latents = manifold.training_latents.cpu().double().numpy().reshape(count, -1, manifold.latent_dim)
        values = manifold.training_parameters.cpu().double().numpy()
        values = values.reshape(count, -1, values.shape[1])[:, 0]
        mean, deviation = values.mean(0), values.std(0)
        deviation = np.where(deviation > 0, deviation, 1.0)
        return cls((values - mean) / deviation, latents, mean, deviation)

    def standardised(self, parameters: np.ndarray) -> np.ndarray:
        """Parameters [n] in the units of `self.parameters`."""
        return (np.asarray(parameters, float) - self._mean) / self._deviation

    def nearest(self, parameters: np.ndarray) -> np.ndarray:
        """[F, r] latent vectors of the training run whose parameters [n] are nearest; the first of equals."""
        distance = np.linalg.norm(self.parameters - self.standardised(parameters), axis=1)
        return self.latents[int(distance.argmin())]

    def interpolated(self, parameters: np.ndarray) -> np.ndarray:
        """[F, r] latent vectors, frame by frame interpolated over the training parameters.

        The radial basis function |p − q| makes it piecewise linear in one parameter, constant beyond the
        training values.
        """
        values = self.latents.reshape(len(self.latents), -1)
        fit = RBFInterpolator(self.parameters, values, kernel="linear", degree=0)
        return fit(self.standardised(parameters)[None]).reshape(self.latents.shape[1:])


@dataclass(frozen=True)
class CoarseRun:
    """The full-order solver on a grid `factor` times as coarse, with as many particles a cell.

    Attributes:
        x: [F, P, 3] positions [m] of the fine particles at the fine frames; displacements are interpolated
            at rest.
        step_ms, total_ms: mean time of a step, and time of all [ms]; kernels were compiled before.
        steps: taken; dx: its grid spacing [m]; particles: its own.
    """

    x: np.ndarray
    step_ms: float
    total_ms: float
    steps: int
    dx: float
    particles: int


def coarse_run(
    scene: Scene, parameters: dict[str, float], X: np.ndarray, factor: int, precision: str, device: str
) -> CoarseRun | str:
    """Run a scene on a coarser grid, and carry its displacements to the scene's own particles.

    Δt is the largest whole multiple of the scene's that is stable and divides its steps.

    Args:
        scene: the fine one.
        parameters: problem parameters by name.
        X: [P, 3] reference positions of the fine particles [m].
        factor: of Δx; particles become fewer by its third power.
        precision: `fp64` or `fp32`.
        device: `cpu`, `cuda` or `cuda:N`.

    Returns:
        The run; or the reason why there is none, such as a solid that the coarse grid does not resolve.
    """
    try:
        coarse = scene.with_parameters(parameters).coarsened(factor)
        stable = largest_stable_dt(coarse.particles(), coarse.initial_velocity(), coarse.dx)
        multiples = [m for m in range(1, factor + 1) if scene.steps % m == 0 and m * scene.dt <= stable]
        if not multiples:
            return f"dt={scene.dt:g} s is unstable at dx={coarse.dx:g} m"
        multiple = multiples[-1]
        coarse = scene.with_parameters(parameters).coarsened(factor, multiple)
        coarse.full_order(precision=precision, device=device).step(1)  # compiles and loads
        solver = coarse.full_order(precision=precision, device=device)
        frames, wait = [solver.state.numpy()["x"]], synchronizer(device)
        wait()
        seconds = 0.0
        for _ in range(coarse.steps):
            begun = time.perf_counter()
            solver.step(1)
            wait()
            seconds += time.perf_counter() - begun
            frames.append(solver.state.numpy()["x"])
    except NSFError as error:
        return str(error)
    own = torch.as_tensor(coarse.particles().X)
    carried = interpolation(torch.as_tensor(X), own)
    moved = torch.stack([carried.value(torch.as_tensor(x) - own) for x in frames]).numpy()
    at = np.arange(scene.steps + 1) / multiple
    below = np.minimum(at.astype(int), coarse.steps - 1)
    share = (at - below)[:, None, None]
    return CoarseRun(
        x=X + (1.0 - share) * moved[below] + share * moved[below + 1],
        step_ms=1e3 * seconds / coarse.steps,
        total_ms=1e3 * seconds,
        steps=coarse.steps,
        dx=coarse.dx,
        particles=len(own),
    )
