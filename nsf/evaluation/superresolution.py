"""The fields of a reduced run at many more points than they were trained on (paper section 6.2)."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch

from nsf.data import Trajectory
from nsf.dynamics import Rollout
from nsf.dynamics.interop import torch_device, torch_dtype
from nsf.errors import ConfigError, InstabilityError
from nsf.evaluation import metrics
from nsf.evaluation.compare import at_frames
from nsf.kinematics.interpolation import interpolation, lying_together
from nsf.mpm import FullOrderMPM, diagnosed, precision_of
from nsf.mpm.device import warp_device
from nsf.timing import synchronizer

POINTS = 1 << 15  # queried at once: their modes and weights take some hundred MiB


@dataclass(frozen=True)
class SuperResolution:
    """What one parameter value gave; errors are fractions over the chosen frames, ∞ when the run diverged.

    Attributes:
        row: of `superresolution.csv`:
            parameter, factor, points (factor × particles);
            delta, displacement_error: of the fields at the points, against a full-order run of as many
            particles on the same grid;
            particles_delta, particles_displacement_error: the same at the training particles, which are
            among the points, alone;
            full_order_difference: displacement error of the full-order run of the training particles
            against the fine one, at the particles they share: what no field can know;
            interpolation_error: displacement error at the points left out, where the fine run's own
            positions at the training particles are interpolated to them (moving least squares);
            smeared: share of those that end more than half a grid cell away in the last frame;
            query_difference [m]: largest distance between the fields at a training particle and at a
            point in its place;
            seconds: of all queries; full_order_seconds: of the fine full-order run.
        X: [n, 3] points at rest [m]; x_reduced, x_full: [n, 3] in the last frame [m].
        particles: [P] rows of the training particles among the points.
    """

    row: dict[str, float]
    X: np.ndarray
    x_reduced: np.ndarray
    x_full: np.ndarray
    particles: np.ndarray


def query(manifold, X: torch.Tensor, xhat: torch.Tensor) -> torch.Tensor:
    """g(X, x̂) on the host, by groups of points, so that neither modes nor weights of all are held at once.

    Args:
        manifold: trained fields, on the device of x̂.
        X: [n, 3] points at rest [m], anywhere in Ω₀.
        xhat: [F, r] latent vectors.

    Returns:
        [F, n, 3] positions [m], in the type of x̂.

    Source: paper section 6.2, "evaluating the neural deformation fields at more X_p ∈ Ω₀".
    """
    x = torch.empty(len(xhat), *X.shape, dtype=xhat.dtype)
    for rows in lying_together(X, POINTS):
        at = manifold.restrict(X=X[rows], dtype=xhat.dtype, device=xhat.device)
        x[:, rows.cpu()] = at.position(xhat).cpu()
    return x


def interpolated(X: torch.Tensor, particles: torch.Tensor, values: torch.Tensor, device) -> torch.Tensor:
    """Values [F, P, 3] at particles [P, 3] interpolated to points X [n, 3]: [F, n, 3], on the host."""
    found = torch.empty(len(values), *X.shape, dtype=values.dtype)
    particles, values = particles.to(device), values.to(device).movedim(0, 1)
    for rows in lying_together(X, POINTS):
        at_rows = interpolation(X[rows].to(device), particles).value(values)
        found[:, rows] = at_rows.movedim(1, 0).cpu()
    return found


def superresolve(
    manifold,
    scene,
    trajectory: Trajectory,
    rollout: Rollout,
    factor: int,
    frames: Sequence[int],
    substeps: int = 1,
    precision: str = "fp64",
    device: str = "auto",
) -> SuperResolution:
    """Query a rollout at factor × the particles and compare with a full-order run of as many.

    The fine run is made here and not stored: at the paper's size its trajectory would fill a disk.

    Args:
        manifold: of the rollout.
        scene: that was deployed on.
        trajectory: its full-order run at the rollout's parameter.
        rollout: the reduced run.
        factor: points for each particle.
        frames: of the trajectory, in ascending order, without frame 0.
        substeps: steps of the fine run for each step; its Δt is as much smaller.
        precision, device: of both.

    Raises:
        ConfigError: the rollout was handed over to the full-order solver, so its fields end before the scene.
        InstabilityError: the fine run is unstable where the coarse one is not, as more particles meet
            more extreme strains; names the remedy.
    """
    name = scene.parameters.name
    if rollout.handed_over >= 0:
        raise ConfigError(
            f"the reduced run at {name}={rollout.parameter:g} was handed over to the full-order solver at "
            f"t = {rollout.t[rollout.handed_over]:.4g} s and has no fields beyond; "
            "deploy with deploy.on_distrust=report"
        )
    fine = scene.refined(factor, substeps)
    where = torch_device(warp_device(device))
    wait = synchronizer(where)
    X = fine.particles().X
    shared = _rows_in(fine, scene)

    started = time.perf_counter()
    x_full = _full_order_frames(
        partial(fine.full_order, {name: rollout.parameter}, precision, device), substeps * np.array(frames)
    )
    full_order_seconds = time.perf_counter() - started

    dtype = torch_dtype(precision_of(precision))
    t = trajectory.t[list(frames)]
    good = rollout.t if rollout.diverged < 0 else rollout.t[: rollout.diverged]
    xhat = torch.as_tensor(at_frames(rollout, np.minimum(t, good[-1])), dtype=dtype, device=where)
    manifold = manifold.to(where)
    wait()
    started = time.perf_counter()
    x = query(manifold, torch.as_tensor(X, device=where), xhat)
    wait()
    seconds = time.perf_counter() - started

    x_full, X_all = torch.as_tensor(x_full), torch.as_tensor(X)
    interpolation_error, smeared = _interpolation_errors(X_all, x_full, shared, 0.5 * scene.dx, where)
    at_particles = manifold.restrict(dtype=dtype, device=where).position(xhat).cpu()
    coarse = torch.as_tensor(np.stack([trajectory.read("x", frame)[0] for frame in frames]))

    def errors(of) -> tuple[float, float]:
        if rollout.diverged >= 0 and rollout.t[rollout.diverged] <= t[-1]:
            return np.inf, np.inf
        found = metrics.displacement_error(x[:, of], x_full[:, of], X_all[of])
        return metrics.deformation_error(x[:, of], x_full[:, of]), found

    delta, displacement_error = errors(slice(None))
    particles_delta, particles_displacement_error = errors(shared)
    row = {
        "parameter": rollout.parameter,
        "factor": factor,
        "points": len(X),
        "delta": delta,
        "displacement_error": displacement_error,
        "particles_delta": particles_delta,
        "particles_displacement_error": particles_displacement_error,
        "full_order_difference": metrics.displacement_error(coarse, x_full[:, shared], X_all[shared]),
        "interpolation_error": interpolation_error,
        "smeared": smeared,
        "query_difference": float((x[:, shared] - at_particles).norm(dim=2).max()),
        "seconds": seconds,
        "full_order_seconds": full_order_seconds,
    }
    return SuperResolution(row, X, x[-1].numpy(), x_full[-1].numpy(), shared)


def _interpolation_errors(
    X: torch.Tensor, x: torch.Tensor, shared: np.ndarray, far: float, device
) -> tuple[float, float]:
    """Displacement error of the points that are not shared, interpolated from those that are.

    Args:
        X: [n, 3] points at rest [m]; x: [F, n, 3] [m].
        shared: [P] rows to interpolate from.
        far: distance [m] beyond which a point counts as smeared.
        device: where the interpolation is made.

    Returns:
        The error, and the share of points smeared in the last frame.
    """
    left_out = np.setdiff1d(np.arange(len(X)), shared)
    X_left, x_left = X[left_out], x[:, left_out]
    x_between = interpolated(X_left, X[shared], x[:, shared], device)
    smeared = ((x_between[-1] - x_left[-1]).norm(dim=1) > far).double().mean()
    return metrics.displacement_error(x_between, x_left, X_left), float(smeared)


def _full_order_frames(build: Callable[[], FullOrderMPM], steps: Sequence[int]) -> np.ndarray:
    """Positions [F, n, 3] [m] after some numbers of steps."""
    solver = build()
    x = np.empty((len(steps), len(solver.constants), 3))
    try:
        for k, step in enumerate(steps):
            solver.step(step - solver.steps_taken)
            x[k] = solver.state.x.numpy()
        solver.check()
    except InstabilityError as error:
        found = diagnosed(error, build, solver.steps_taken)
        raise InstabilityError(f"fine full-order run: {found}; raise super_resolution.substeps") from error
    return x


def _rows_in(fine, scene) -> np.ndarray:
    """Rows of a scene's particles among those of the scene that `Scene.refined` makes of it."""
    ends = np.cumsum([body.particles for body in fine.bodies])
    bodies = zip(ends, fine.bodies, scene.bodies, strict=True)
    return np.concatenate([end - more.particles + np.arange(few.particles) for end, more, few in bodies])
