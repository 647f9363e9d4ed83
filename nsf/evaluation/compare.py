"""A reduced run beside its full-order truth, frame by frame."""

import copy
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pandas as pd
import torch

from nsf.data import Trajectory
from nsf.deployment import FULL_ORDER, Rollout
from nsf.dynamics import Decoder, ReducedMPM
from nsf.dynamics.setup import Setup
from nsf.errors import SchemaError
from nsf.evaluation import metrics
from nsf.evaluation.surroundings import surroundings
from nsf.kinematics.blocks import frames_at_once
from nsf.quantities import QUANTITIES, at_end, height
from nsf.vectors import at_times, spaced

_VALUES = 40  # of a particle and frame that are held together: x and τ of three kinds
#: Errors of runs, and the squares that they are ratios of.
_OF_RUNS = {
    "delta": ("x_error", "x_norm"),
    "displacement_error": ("x_error", "u_norm"),
    "stress_error": ("tau_error", "tau_norm"),
}
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
        solver: the reduced solver of the rollout: it says where τ comes from. Where particles carried it,
            in a run of its own steps at the scene's Δt to the end, it takes the run once more; else the
            fields count.
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
    manifold, setup = solver.manifold, solver.setup
    device = setup.torch_device
    manifold.check_particles(trajectory.x_sha256)
    if manifold.X.device != device:  # frames are encoded where they are
        manifold = copy.deepcopy(manifold).to(device)
    if rollout.by == FULL_ORDER and (taken is None or taken.frames != trajectory.frames):
        raise SchemaError(
            f"the full-order solver took the run at {rollout.case.named}, and its {trajectory.frames} frames "
            "are not there; deploy again"
        )

    def tensor(values) -> torch.Tensor:
        # To the device before the wider type: half the bytes travel, and the device converts.
        return torch.as_tensor(np.asarray(values)).to(device).to(setup.dtype)

    xhat, good = _until_lost(rollout, trajectory.t)
    xhat, X, decoder = tensor(xhat), tensor(trajectory.X), solver.decoder()
    stress = None
    if rollout.stress is not None:
        stress = at_times(trajectory.t, rollout.t, rollout.stress)
        stress[~good] = stress[good][-1]
        stress = tensor(stress)
    shown, rows = _Pictures(solver, trajectory, *pictures), {}
    carried = _Carried(solver, trajectory.every) if _carries(solver, rollout, trajectory) else None
    per_chunk = frames_at_once(_VALUES * trajectory.particles, setup.dtype, device)
    for start in range(0, trajectory.frames, per_chunk):
        block = slice(start, min(start + per_chunk, trajectory.frames))
        x, tau = (tensor(trajectory.read(name, frames=block)) for name in ("x", "tau"))
        if taken:
            x_rom, tau_rom = (tensor(taken.read(name, frames=block)) for name in ("x", "tau"))
        else:
            x_rom, tau_rom = _fields(decoder, xhat[block], None if stress is None else stress[block], carried)
        encoded = manifold.encode(x).to(setup.dtype)
        noted = _squares(x, tau, x_rom, tau_rom, X)
        x_rec, tau_rec = decoder.position(encoded), decoder.at.stress(encoded, setup.parameters)
        noted |= {
            "rec_error": metrics.frame_squares(x_rec - x),
            "rec_tau_error": metrics.tensor_squares(tau_rec - tau),
            "height_rom": height(x_rom, X),
            "height_fom": height(x, X),
            "encoded": encoded,
        }
        for name, values in noted.items():
            rows.setdefault(name, []).append(values.cpu())
        shown.take(block, x, tau, x_rom, tau_rom)
        advance(block.stop - block.start)
    column = {name: torch.cat(values) for name, values in rows.items()}
    errors = _totals(column, rollout, len(X))
    ends = [at_end(column[f"height_{of}"], shape[-1], X) for of, shape in (("rom", x_rom), ("fom", x))]
    diverged = rollout.diverged >= 0
    if taken:
        xhat[:] = torch.nan  # full-order frames are no latent vectors
    return Comparison(
        **errors,
        quantities={name: np.inf if diverged else ends[0][name] - ends[1][name] for name in QUANTITIES},
        series=_series(column, rollout, trajectory.t, split, xhat.cpu(), good),
        pictures=shown.arrays | surroundings(solver.scene, shown.arrays["t"]),
    )


def _until_lost(rollout: Rollout, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Latent vectors [F, r] at frames, those after a run was lost as the last good one, and which are good.

    Frames are good up to the last good step: those after it lie between a good latent vector and a lost one.
    """
    xhat = at_frames(rollout, t)
    last = rollout.t[rollout.diverged - 1] if rollout.diverged >= 0 else np.inf
    good = t <= last + _SAME_TIME
    xhat[~good] = xhat[good][-1]
    return xhat, good


def _squares(x, tau, x_rom, tau_rom, X) -> dict[str, torch.Tensor]:
    """Sums of squares [F] over particles, of differences and of what these are held to."""
    return {
        "x_error": metrics.frame_squares(x_rom - x),
        "x_norm": metrics.frame_squares(x),
        "u_norm": metrics.frame_squares(x - X),
        "tau_error": metrics.tensor_squares(tau_rom - tau),
        "tau_norm": metrics.tensor_squares(tau),
    }


def _totals(column: dict[str, torch.Tensor], rollout: Rollout, particles: int) -> dict[str, float]:
    """Errors over frames 1..N, as `Comparison` has them.

    Raises:
        InstabilityError: one is not finite, though the run did not diverge.
    """

    def total(error: str, norm: str) -> float:
        return metrics.relative(column[error][1:], column[norm][1:])

    errors = {
        "reconstruction_delta": total("rec_error", "x_norm"),
        "reconstruction_stress_error": total("rec_tau_error", "tau_norm"),
    }
    lost = [*_OF_RUNS, "distance", "distance_max"]
    if rollout.diverged < 0:
        errors |= {name: total(*columns) for name, columns in _OF_RUNS.items()}
        errors["distance"] = float((column["x_error"][1:].mean() / particles).sqrt())
        errors["distance_max"] = float((column["x_error"].max() / particles).sqrt())
        lost = []
        if not column["tau_error"][1:].isfinite().all():  # a body that is turned inside out has no stress
            lost = ["stress_error"]
            errors.pop("stress_error")
    metrics.require_finite(errors, rollout.case.named)
    return errors | dict.fromkeys(lost, np.inf)


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

    return pd.DataFrame(
        {
            "case": rollout.case.named,
            "split": split,
            "frame": np.arange(len(t)),
            "t": t,
            "delta": by_frame("x_error", "x_norm"),
            "displacement_error": moving("x_error", "u_norm"),
            "stress_error": moving("tau_error", "tau_norm"),
            "reconstruction_delta": (column["rec_error"] / column["x_norm"]).sqrt(),
            "error_bound": bound_at_frames(rollout, t),
            **{f"xhat_{k + 1}": xhat[:, k] for k in range(xhat.shape[1])},
            **{f"encoded_{k + 1}": column["encoded"][:, k] for k in range(xhat.shape[1])},
        }
    )


class _Pictures:
    """Some particles in some frames, which are taken as the frames pass.

    Args:
        solver: of the reduced run; trajectory: the full-order one.
        particles, frames: how many, at most.
    """

    def __init__(self, solver: ReducedMPM, trajectory: Trajectory, particles: int, frames: int):
        self._setup, self._frames = solver.setup, spaced(trajectory.frames, frames)
        self._samples = {n: _sample_at(solver, trajectory.t[n]) for n in self._frames}
        self._shown = _shown(trajectory.particles, particles, np.concatenate(list(self._samples.values())))
        self._t, self._kept = trajectory.t[self._frames], {}

    def take(self, block: slice, x, tau, x_rom, tau_rom) -> None:
        """Keep what is shown of the frames of a block [F, P, 3] [m] and [F, P, 6] [Pa]."""
        inside = [n - block.start for n in self._frames if block.start <= n < block.stop]
        roles = [_roles(self._setup, x_rom[n], self._samples[block.start + n])[self._shown] for n in inside]
        fields = {"x_full": x, "x_reduced": x_rom, "stress_full": tau, "stress_reduced": tau_rom}
        arrays = {}
        for name, values in fields.items():
            shown = values[inside][:, self._shown]
            if name.startswith("stress"):  # 0 where a law has none, as of a body turned inside out
                shown = torch.nan_to_num(metrics.von_mises(shown).float())
            arrays[name] = shown.float().cpu().numpy()
        arrays["role"] = np.array(roles, np.int8).reshape(len(inside), len(self._shown))
        for name, values in arrays.items():
            self._kept.setdefault(name, []).append(values)

    @property
    def arrays(self) -> dict[str, np.ndarray]:
        """For `frames.npz`."""
        return {name: np.concatenate(blocks) for name, blocks in self._kept.items()} | {"t": self._t}


def _fields(
    decoder: Decoder, xhat: torch.Tensor, stress: torch.Tensor | None, carried: "_Carried | None"
) -> tuple[torch.Tensor, torch.Tensor]:
    """x [F, P, 3] [m] and τ [F, P, 6] [Pa] of some frames of a reduced run.

    Args:
        decoder: the fields at every particle.
        xhat: [F, r]; stress: [F, n_s] ŝ of a run that has them.
        carried: gives τ in place of the fields; frames before these were asked for already.
    """
    tau = decoder.stress(xhat, stress) if carried is None else carried.next(len(xhat))
    return decoder.position(xhat), tau[..., _UPPER[0], _UPPER[1]]


def _carries(solver: ReducedMPM, rollout: Rollout, trajectory: Trajectory) -> bool:
    """Whether the solver takes the steps of the rollout itself, and its particles carry their stress."""
    whole = not solver.span.latent_only and rollout.by != FULL_ORDER and rollout.diverged < 0
    return solver.setup.sources.carried and whole and solver.dt == trajectory.dt


class _Carried:
    """τ that particles carry along a run, frame by frame from t = 0 on.

    Args:
        solver: takes the run's steps once more.
        every: steps from a frame to the next.
    """

    def __init__(self, solver: ReducedMPM, every: int):
        solver.restart()
        self._solver, self._every, self._first = solver, every, True

    def next(self, frames: int) -> torch.Tensor:
        """τ [F, P, 3, 3] [Pa] of the next frames."""
        steps = []
        for _ in range(frames):
            if not self._first:
                self._solver.step(self._every)
            self._first, span = False, self._solver.span
            order = torch.as_tensor(span.order, device=span.tau.device)
            steps.append(torch.empty_like(span.tau).index_copy_(0, order, span.tau))
        return torch.stack(steps)


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
