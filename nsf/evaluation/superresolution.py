"""The fields of a reduced run at many more points than they were trained on (paper section 6.2)."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch

from nsf.data import Trajectory
from nsf.deployment import FULL_ORDER, Rollout
from nsf.dynamics.interop import as_tensor, torch_device, torch_dtype
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
    """Errors and shapes of one case; errors are fractions over the chosen frames, ∞ when the run diverged.

    Attributes:
        row: of `superresolution.csv`:
            case, factor, points (factor × particles);
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
            seconds: of the query of all cases together, shared equally; full_order_seconds: of the fine
            full-order run, its set-up included.
        X: [n, 3] points at rest [m]; x_reduced, x_full: [n, 3] in the last frame [m].
        particles: [P] rows of the training particles among the points.
    """

    row: dict[str, float | str]
    X: np.ndarray
    x_reduced: np.ndarray
    x_full: np.ndarray
    particles: np.ndarray


def query(manifold, X: torch.Tensor, xhat: torch.Tensor) -> torch.Tensor:
    """g(X, x̂), by groups of points, so that neither modes nor weights of all are held at once.

    Args:
        manifold: trained fields.
        X: [n, 3] points at rest [m], anywhere in Ω₀.
        xhat: [F, r] latent vectors; all three are on one device.

    Returns:
        [F, n, 3] positions [m], in the type of x̂.

    Source: paper section 6.2, "evaluating the neural deformation fields at more X_p ∈ Ω₀".
    """
    x = xhat.new_empty(len(xhat), *X.shape)
    for rows in lying_together(X, POINTS):
        x[:, rows] = manifold.restrict(X=X[rows], dtype=xhat.dtype, device=xhat.device).position(xhat)
    return x


def interpolated(X: torch.Tensor, particles: torch.Tensor, values: torch.Tensor) -> torch.Tensor:
    """Values [F, P, 3] at particles [P, 3] interpolated to points X [n, 3]: [F, n, 3], all on one device."""
    x = values.new_empty(len(values), *X.shape)
    values = values.movedim(0, 1)
    for rows in lying_together(X, POINTS):
        x[:, rows] = interpolation(X[rows], particles).value(values).movedim(1, 0)
    return x


def superresolve(
    manifold,
    scene,
    trajectories: Sequence[Trajectory],
    rollouts: Sequence[Rollout],
    factor: int,
    frames: Sequence[int],
    substeps: int = 1,
    precision: str = "fp64",
    device: str = "auto",
    say: Callable[[str], object] = lambda line: None,
) -> list[SuperResolution]:
    """Query rollouts at factor × the particles and compare each with a full-order run of as many.

    The fine runs are made here and not stored: at the paper's size their trajectories would fill a disk.
    Neighbours, weights and modes depend on the points alone and are found once for all rollouts. Frames stay
    on the device, of all rollouts at once: about 100 bytes a point, frame and rollout at the most.

    Args:
        manifold: of the rollouts.
        scene: that was deployed on.
        trajectories: its full-order run of each rollout's case.
        rollouts: the reduced runs.
        factor: points for each particle.
        frames: of the trajectories, in ascending order, without frame 0.
        substeps: steps of the fine run for each step; its Δt is as much smaller.
        precision, device: of all.
        say: told of each fine run.

    Raises:
        ConfigError: the full-order solver took a rollout, which has no fields.
        InstabilityError: a fine run is unstable where the coarse one is not, as more particles meet
            more extreme strains; names the remedy. Or an error is not finite.
    """
    for rollout in rollouts:
        _check_own(rollout)
    fine = scene.refined(factor, substeps)
    where = torch_device(warp_device(device))
    wait = synchronizer(where)
    points, particles = fine.particles().X, _rows_in(fine, scene)
    X, shared = (torch.as_tensor(a, device=where) for a in (points, particles))

    x_full, full_order_seconds = [], []
    for rollout in rollouts:
        started = time.perf_counter()
        build = partial(fine.full_order, rollout.case, precision, device)
        x_full.append(_full_order_frames(build, substeps * trajectories[0].every * np.array(frames)))
        full_order_seconds.append(time.perf_counter() - started)
        took = f"{len(X):,} full-order particles in {full_order_seconds[-1]:.1f} s"
        say(f"superresolve: {rollout.case.named}: {took}")
    interpolation_errors = _interpolation_errors(X, x_full, shared, 0.5 * scene.dx)

    dtype = torch_dtype(precision_of(precision))
    latents = [_latents(*run, frames) for run in zip(rollouts, trajectories, strict=True)]
    xhat = torch.as_tensor(np.concatenate(latents), dtype=dtype, device=where)
    manifold = manifold.to(where)
    wait()
    started = time.perf_counter()
    x = query(manifold, X, xhat)
    wait()
    seconds = (time.perf_counter() - started) / len(rollouts)
    at_particles = manifold.restrict(dtype=dtype, device=where).position(xhat)

    results = []
    of_each = zip(x.split(len(frames)), at_particles.split(len(frames)), x_full, strict=True)
    for k, (x_k, at_particles_k, x_full_k) in enumerate(of_each):
        head = {"case": rollouts[k].case.named, "factor": factor, "points": len(X)}
        errors = _errors(rollouts[k], trajectories[k], frames, x_k, x_full_k, X, shared)
        interpolation_error, smeared = interpolation_errors[k]
        rest = {
            "interpolation_error": interpolation_error,
            "smeared": smeared,
            "query_difference": float((x_k[:, shared] - at_particles_k).norm(dim=2).max()),
            "seconds": seconds,
            "full_order_seconds": full_order_seconds[k],
        }
        last = (frames_k[-1].cpu().numpy() for frames_k in (x_k, x_full_k))
        results.append(SuperResolution(head | errors | rest, points, *last, particles))
    return results


def _check_own(rollout: Rollout) -> None:
    """Refuse a rollout whose frames are the full-order solver's."""
    if rollout.by == FULL_ORDER:
        raise ConfigError(
            f"the full-order solver took the run at {rollout.case.named}, which has no fields; deploy with "
            "fallback=none"
        )


def _latents(rollout: Rollout, trajectory: Trajectory, frames: Sequence[int]) -> np.ndarray:
    """Latent vectors [F, r] at frames; the last good one after a divergence."""
    good = rollout.t if rollout.diverged < 0 else rollout.t[: rollout.diverged]
    return at_frames(rollout, np.minimum(trajectory.t[list(frames)], good[-1]))


def _errors(
    rollout: Rollout,
    trajectory: Trajectory,
    frames: Sequence[int],
    x: torch.Tensor,
    x_full: torch.Tensor,
    X: torch.Tensor,
    shared: torch.Tensor,
) -> dict[str, float]:
    """Columns of `SuperResolution.row` from delta to full_order_difference.

    Args:
        rollout, trajectory: of one case.
        frames: of the trajectory.
        x, x_full: [F, n, 3] of the fields and of the fine run [m].
        X: [n, 3] points at rest [m].
        shared: [P] rows of the training particles.
    """
    last = trajectory.t[frames[-1]]
    lost = rollout.diverged >= 0 and rollout.t[rollout.diverged] <= last
    coarse = torch.as_tensor(np.stack([trajectory.read("x", frame)[0] for frame in frames])).to(X.device)
    few = (x[:, shared], x_full[:, shared])
    errors = {
        "delta": metrics.deformation_error(x, x_full),
        "displacement_error": metrics.displacement_error(x, x_full, X),
        "particles_delta": metrics.deformation_error(*few),
        "particles_displacement_error": metrics.displacement_error(*few, X[shared]),
    }
    difference = {"full_order_difference": metrics.displacement_error(coarse, few[1], X[shared])}
    metrics.require_finite(difference if lost else errors | difference, f"t = {last:.4g} s")
    return (dict.fromkeys(errors, np.inf) if lost else errors) | difference


def _interpolation_errors(
    X: torch.Tensor, x: Sequence[torch.Tensor], shared: torch.Tensor, far: float
) -> list[tuple[float, float]]:
    """Displacement errors of the points that are not shared, interpolated from those that are.

    Args:
        X: [n, 3] points at rest [m]; x: [F, n, 3] [m] of each run, on one device.
        shared: [P] rows to interpolate from.
        far: distance [m] beyond which a point counts as smeared.

    Returns:
        Of each run the error, and the share of points smeared in the last frame.
    """
    left_out = torch.ones(len(X), dtype=torch.bool, device=X.device).index_fill(0, shared, False)
    left_out = left_out.nonzero()[:, 0]
    X_left, errors = X[left_out], []
    x_between = interpolated(X_left, X[shared], torch.cat([run[:, shared] for run in x]))
    for run, run_between in zip(x, x_between.chunk(len(x)), strict=True):
        x_left = run[:, left_out]
        smeared = ((run_between[-1] - x_left[-1]).norm(dim=1) > far).double().mean()
        errors.append((metrics.displacement_error(run_between, x_left, X_left), float(smeared)))
    return errors


def _full_order_frames(build: Callable[[], FullOrderMPM], steps: Sequence[int]) -> torch.Tensor:
    """Positions [F, n, 3] [m] after some numbers of steps, in fp64 on the solver's device."""
    solver = build()
    wait = synchronizer(solver.device)
    rows, order = as_tensor(solver.state.x.rows), as_tensor(solver.state.order)
    x = torch.empty(len(steps), *rows.shape, dtype=torch.float64, device=rows.device)
    try:
        for k, step in enumerate(steps):
            solver.step(step - solver.steps_taken)
            wait()  # the solver's stream and torch's do not wait for each other
            x[k, order.long()] = rows.double()
            wait()
        solver.check()
    except InstabilityError as error:
        reason = diagnosed(error, build, solver.steps_taken)
        raise InstabilityError(f"fine full-order run: {reason}; raise super_resolution.substeps") from error
    return x


def _rows_in(fine, scene) -> np.ndarray:
    """Rows of a scene's particles among those of the scene that `Scene.refined` makes of it."""
    ends = np.cumsum([body.particles for body in fine.bodies.values()])
    bodies = zip(ends, fine.bodies.values(), scene.bodies.values(), strict=True)
    return np.concatenate([end - more.particles + np.arange(few.particles) for end, more, few in bodies])
