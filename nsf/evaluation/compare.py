"""A reduced run beside its full-order truth, frame by frame."""

import copy
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pandas as pd
import torch

from nsf.data import Trajectory
from nsf.data.schema import COMPONENTS
from nsf.deployment import FULL_ORDER, Rollout
from nsf.dynamics import Decoder, ReducedMPM
from nsf.dynamics.setup import Setup
from nsf.errors import SchemaError
from nsf.evaluation import metrics
from nsf.evaluation.surroundings import surroundings
from nsf.kinematics.blocks import frames_at_once
from nsf.mpm.grid.shape import DEGREES
from nsf.quantities import QUANTITIES, at_end, height
from nsf.vectors import at_times, spaced

_VALUES = 90  # of a particle and frame that are held together: x, v, C and τ of three kinds
_SAME_TIME = 1e-9  # [s]
_HARDLY = 1e-4  # of the most in a run
_UPPER = ([0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2])  # entries xx, xy, xz, yy, yz, zz of a symmetric matrix


@dataclass(frozen=True)
class Comparison:
    """Errors, series and pictures of one case.

    Attributes:
        delta, displacement_error, stress_error: totals over frames 1..N, fractions; ∞ when the run diverged.
            `stress_error` is also ∞ where the run's stress is not finite in some frame.
            Of a run that the full-order solver took, its frames count like reduced ones.
        distance: from the full-order run, RMS over particles and frames 1..N [m]; distance_max: largest of a
            frame, RMS over particles [m]; ∞ likewise.
        quantities: by name, a scalar of the shape at the end less the full-order run's [m]; ∞ likewise.
        reconstruction_delta, reconstruction_stress_error: of the full-order frames encoded and decoded.
        series: one row a frame (design.md).
        pictures: arrays for `frames.npz`.
    """

    delta: float
    displacement_error: float
    stress_error: float
    distance: float
    distance_max: float
    quantities: dict[str, float]
    reconstruction_delta: float
    reconstruction_stress_error: float
    series: pd.DataFrame
    pictures: dict[str, np.ndarray]


def at_frames(rollout: Rollout, t: np.ndarray) -> np.ndarray:
    """Latent vectors [F, r] at the full-order frame times, linear between deployment steps."""
    return at_times(t, rollout.t, rollout.xhat)


def bound_at_frames(rollout: Rollout, t: np.ndarray) -> np.ndarray:
    """Error bound [F] [m] at the full-order frame times: that of the first step which has reached them.

    NaN of a run by the full-order solver.
    """
    if rollout.by == FULL_ORDER:
        return np.full(len(t), np.nan)
    reached = np.minimum(np.searchsorted(rollout.t, t - _SAME_TIME), len(rollout.t) - 1)
    return rollout.verdict.bound[reached]


def compare(
    solver: ReducedMPM,
    trajectory: Trajectory,
    rollout: Rollout,
    split: str,
    pictures: tuple[int, int],
    taken: Trajectory | None = None,
    advance: Callable[[int], object] = lambda frames: None,
) -> Comparison:
    """Errors of a rollout against the trajectory of the same case.

    Args:
        solver: the reduced solver of the rollout: it says where τ and C come from. Where particles
            carried them, in a run of its own steps at the scene's Δt to the end, it takes the run once more;
            else the fields count.
        trajectory: the full-order run.
        rollout: the reduced run.
        split: `test`, `validation` or `train`.
        pictures: numbers of particles and of frames kept for pictures.
        taken: the frames of a rollout that the full-order solver took.
        advance: told how many frames more are compared.

    Raises:
        SchemaError: the trajectory is of other particles, or the frames of the full-order solver are missing.
        InstabilityError: an error is not finite, though the run did not diverge.
    """
    scene, manifold, setup = solver.scene, solver.manifold, solver.setup
    device, parameters = setup.torch_device, setup.parameters
    manifold.check_particles(trajectory.x_sha256)
    if manifold.X.device != device:  # frames are encoded where they are
        manifold = copy.deepcopy(manifold).to(device)
    decoder = solver.decoder()
    frames = trajectory.frames
    xhat = at_frames(rollout, trajectory.t)
    diverged = rollout.diverged >= 0
    # Frames up to the last good step: those after it lie between a good latent and a lost one.
    last = rollout.t[rollout.diverged - 1] if diverged else np.inf
    good = trajectory.t <= last + _SAME_TIME
    xhat[~good] = xhat[good][-1]  # pictures of a diverged run hold its last state; its errors are ∞
    if rollout.by == FULL_ORDER and (taken is None or taken.frames != frames):
        raise SchemaError(
            f"the full-order solver took the run at {rollout.case.named}, and its {frames} frames are not "
            "there; deploy again"
        )

    def tensor(values) -> torch.Tensor:
        # To the device before the wider type: half the bytes travel, and the device converts.
        return torch.as_tensor(np.asarray(values)).to(device).to(setup.dtype)

    before = at_frames(rollout, trajectory.t - trajectory.dt)
    before[~good] = xhat[~good]
    xhat, before, X, mass = map(tensor, (xhat, before, trajectory.X, trajectory.mass))
    rate = (xhat - before) / trajectory.dt
    rate[0] = solver.first_rate
    stress = None if rollout.stress is None else tensor(at_times(trajectory.t, rollout.t, rollout.stress))
    latents = _Latents(xhat, before, rate, stress, trajectory.dt)
    inertia = scene.dx**2 * (DEGREES[scene.transfer.shape] + 1) / 12.0
    shown_frames = spaced(frames, pictures[1])
    samples = {n: _sample_at(solver, trajectory.t[n]) for n in shown_frames}
    shown_particles = _shown(trajectory.particles, pictures[0], np.concatenate(list(samples.values())))
    kept = {name: [] for name in ("x_full", "x_reduced", "stress_full", "stress_reduced", "role")}
    rows: dict[str, list] = {}

    def note(**values: torch.Tensor) -> None:
        for name, value in values.items():
            rows.setdefault(name, []).append(value.cpu())

    carried = _Carried(solver, trajectory.every) if _carries(solver, rollout, trajectory) else None
    per_chunk = frames_at_once(_VALUES * trajectory.particles, setup.dtype, device)
    for start in range(0, frames, per_chunk):
        block = slice(start, min(start + per_chunk, frames))
        x, tau, C, v = (tensor(trajectory.read(name, frames=block)) for name in ("x", "tau", "C", "v"))
        C = C.view(*C.shape[:2], 3, 3)
        x_rom, v_rom, C_rom, tau_rom = (
            _read(taken, block, x) if taken else _reduced_fields(decoder, latents.rows(block), carried)
        )
        if start == 0:
            v_rom[0] = v[0]
        encoded = manifold.encode(x).to(setup.dtype)
        x_rec, tau_rec = decoder.position(encoded), decoder.at.stress(encoded, parameters)
        note(
            x_error=metrics.frame_squares(x_rom - x),
            x_norm=metrics.frame_squares(x),
            u_norm=metrics.frame_squares(x - X),
            tau_error=metrics.tensor_squares(tau_rom - tau),
            tau_norm=metrics.tensor_squares(tau),
            rec_error=metrics.frame_squares(x_rec - x),
            rec_tau_error=metrics.tensor_squares(tau_rec - tau),
            p_rom=metrics.linear_momentum(v_rom, mass),
            p_fom=metrics.linear_momentum(v, mass),
            p_scale=(v.norm(dim=2) * mass).sum(1),
            L_rom=metrics.angular_momentum(x_rom, v_rom, C_rom, mass, inertia),
            L_fom=metrics.angular_momentum(x, v, C, mass, inertia),
            L_scale=(x.norm(dim=2) * v.norm(dim=2) * mass).sum(1),
            height_rom=height(x_rom, X),
            height_fom=height(x, X),
            encoded=encoded,
        )
        inside = [n - start for n in shown_frames if block.start <= n < block.stop]
        for name, values in (
            ("x_full", x),
            ("x_reduced", x_rom),
            ("stress_full", tau),
            ("stress_reduced", tau_rom),
        ):
            shown = values[inside][:, shown_particles]
            shown = metrics.von_mises(shown) if name.startswith("stress") else shown
            kept[name].append(shown.float().cpu().numpy())
        roles = [_roles(setup, x_rom[n], samples[start + n])[shown_particles] for n in inside]
        kept["role"].append(np.array(roles, np.int8).reshape(len(inside), len(shown_particles)))
        advance(block.stop - block.start)

    column = {name: torch.cat(values) for name, values in rows.items()}

    def total(error: str, norm: str) -> float:  # over frames 1..N
        return metrics.relative(column[error][1:], column[norm][1:])

    errors = {
        "reconstruction_delta": total("rec_error", "x_norm"),
        "reconstruction_stress_error": total("rec_tau_error", "tau_norm"),
    }
    reduced = {
        "delta": ("x_error", "x_norm"),
        "displacement_error": ("x_error", "u_norm"),
        "stress_error": ("tau_error", "tau_norm"),
    }
    lost = set(reduced) if diverged else set()
    if (
        not column["tau_error"][1:].isfinite().all()
    ):  # a law has no stress of a body that is turned inside out
        lost.add("stress_error")
    errors |= {name: total(*columns) for name, columns in reduced.items() if name not in lost}
    if not diverged:
        errors["distance"] = float((column["x_error"][1:].mean() / len(X)).sqrt())
        errors["distance_max"] = float((column["x_error"].max() / len(X)).sqrt())
    metrics.require_finite(errors, rollout.case.named)
    ends = [at_end(column[f"height_{of}"], shape[-1], X) for of, shape in (("rom", x_rom), ("fom", x))]
    off = {name: np.inf if diverged else ends[0][name] - ends[1][name] for name in QUANTITIES}
    if taken:
        xhat[:] = torch.nan  # full-order frames are no latent vectors
    return Comparison(
        **dict.fromkeys((*reduced, "distance", "distance_max"), np.inf) | errors,
        quantities=off,
        series=_series(column, rollout, trajectory.t, split, xhat.cpu(), good),
        pictures={name: np.concatenate(blocks) for name, blocks in kept.items()}
        | {"t": trajectory.t[shown_frames]}
        | surroundings(scene, trajectory.t[shown_frames]),
    )


def _series(
    column: dict[str, torch.Tensor],
    rollout: Rollout,
    t: np.ndarray,
    split: str,
    xhat: torch.Tensor,
    good: np.ndarray,
) -> pd.DataFrame:
    """One row a frame.

    Args:
        column: what `compare` notes of each frame, by name.
        rollout: the reduced run.
        t: [F] time of each frame [s].
        split: `test`, `validation` or `train`.
        xhat: [F, r] latent vectors, on the host.
        good: [F] whether the run had not diverged; errors of other frames are ∞.
    """
    bad = torch.as_tensor(~good)

    def by_frame(error: str, norm: str) -> torch.Tensor:
        return (column[error] / column[norm]).sqrt().masked_fill(bad, torch.inf)

    def moving(error: str, norm: str) -> torch.Tensor:
        # Where hardly anything has moved or is loaded yet, as at t = 0, a ratio to that tells nothing.
        hardly = column[norm] <= _HARDLY**2 * column[norm].max()
        errors = by_frame(error, norm).masked_fill(hardly, torch.nan)
        return errors.masked_fill(~column[error].isfinite(), torch.inf)

    def momentum(name: str) -> torch.Tensor:
        errors = metrics.momentum_error(column[f"{name}_rom"], column[f"{name}_fom"], column[f"{name}_scale"])
        return errors.masked_fill(bad, torch.inf)

    return pd.DataFrame(
        {
            "case": rollout.case.named,
            "split": split,
            "frame": np.arange(len(t)),
            "t": t,
            "delta": by_frame("x_error", "x_norm"),
            "displacement_error": moving("x_error", "u_norm"),
            "stress_error": moving("tau_error", "tau_norm"),
            "linear_momentum_error": momentum("p"),
            "angular_momentum_error": momentum("L"),
            "reconstruction_delta": (column["rec_error"] / column["x_norm"]).sqrt(),
            "error_bound": bound_at_frames(rollout, t),
            **{f"xhat_{k + 1}": xhat[:, k] for k in range(xhat.shape[1])},
            **{f"encoded_{k + 1}": column["encoded"][:, k] for k in range(xhat.shape[1])},
        }
    )


class _Latents(NamedTuple):
    """Latent vectors at frames.

    Attributes:
        xhat: [F, r]; before: [F, r] x̂ a step before; rate: [F, r] dx̂/dt [1/s].
        stress: [F, n_s] ŝ of a run that has them.
        dt: step [s].
    """

    xhat: torch.Tensor
    before: torch.Tensor
    rate: torch.Tensor
    stress: torch.Tensor | None
    dt: float

    def rows(self, frames: slice) -> "_Latents":
        """Those of some frames."""
        return _Latents(*(None if values is None else values[frames] for values in self[:4]), self.dt)


#: x [F, P, 3] [m], v [F, P, 3] [m/s], C [F, P, 3, 3] [1/s] and τ [F, P, 6] [Pa] of some frames.
_Fields = tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]


def _read(trajectory: Trajectory, frames: slice, like: torch.Tensor) -> _Fields:
    """Fields of some frames of a full-order run."""
    read = (torch.as_tensor(trajectory.read(name, frames=frames)) for name in COMPONENTS)
    x, v, C, tau = (values.to(like) for values in read)
    return x, v, C.unflatten(2, (3, 3)), tau


def _reduced_fields(decoder: Decoder, now: _Latents, carried: "_Carried | None") -> _Fields:
    """Fields of some frames of a reduced run.

    v is the backward difference of a step, as the particles of a full-order run have it.

    Args:
        decoder: the fields at every particle.
        now: latents of the frames; those before them were decoded already.
        carried: gives τ and C in place of the fields.
    """
    if carried is None:
        C, tau = decoder.affine(now.xhat, now.rate), decoder.stress(now.xhat, now.stress)
    else:
        C, tau = carried.next(len(now.xhat))
    x = decoder.position(now.xhat)
    v = (x - decoder.position(now.before)) / now.dt
    return x, v, C, tau[..., _UPPER[0], _UPPER[1]]


def _carries(solver: ReducedMPM, rollout: Rollout, trajectory: Trajectory) -> bool:
    """Whether the solver takes the steps of the rollout itself, and its particles carry their stress."""
    whole = not solver.span.latent_only and rollout.by != FULL_ORDER and rollout.diverged < 0
    return solver.setup.sources.carried and whole and solver.dt == trajectory.dt


class _Carried:
    """τ and C that particles carry along a run, frame by frame from t = 0 on.

    Args:
        solver: takes the run's steps once more.
        every: steps from a frame to the next.
    """

    def __init__(self, solver: ReducedMPM, every: int):
        solver.restart()
        self._solver, self._every, self._first = solver, every, True

    def next(self, frames: int) -> tuple[torch.Tensor, torch.Tensor]:
        """C [F, P, 3, 3] [1/s] and τ [F, P, 3, 3] [Pa] of the next frames."""
        steps = []
        for _ in range(frames):
            if not self._first:
                self._solver.step(self._every)
            self._first, span = False, self._solver.span
            order = torch.as_tensor(span.order, device=span.tau.device)
            steps.append([torch.empty_like(a).index_copy_(0, order, a) for a in (span.C, span.tau)])
        return tuple(torch.stack(values) for values in zip(*steps, strict=True))


def _roles(setup: Setup, x: torch.Tensor, sample: np.ndarray) -> np.ndarray:
    """[P] set of each particle: 2 in S, 1 in N alone, 0 in neither.

    N is what a projected step from the positions x [P, 3] needs, no superset of it that a span may have.
    """
    role = (
        setup.search.integration_mask(x, torch.as_tensor(sample, device=x.device))
        .cpu()
        .numpy()
        .astype(np.int8)
    )
    role[sample] = 2
    return role


def _sample_at(solver: ReducedMPM, t: float) -> np.ndarray:
    """[s] indices of S in the step that starts at t [s], or in the last one."""
    return solver.sets_at(min(round(t / solver.setup.dt), solver.total_steps - 1)).sample


def _shown(particles: int, most: int, sample: np.ndarray) -> np.ndarray:
    """Indices [n] of the particles for pictures, sorted, n ≤ most: those of S first, then a random subset.

    Args:
        particles: P; most: of them, where S may have more.
        sample: indices of S, an index more than once too.
    """
    drawn = (np.random.default_rng(0).permutation(rows) for rows in (np.unique(sample), particles))
    order = np.concatenate(list(drawn))
    _, first = np.unique(order, return_index=True)
    return np.sort(order[np.sort(first)[:most]])
