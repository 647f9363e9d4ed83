"""Whether to believe a reduced run: how far it is from what its fields were trained on.

Three signals tell when a run leaves its training data: the sample particles move where no latent vector can
follow, which leaves a projection residual; the latent vector goes where no training snapshot was; and the
problem parameters, or what forces the run, lie outside of training. Each is measured in units of what
training data themselves show, so that a ratio of 1 means "as far as training data are from themselves". Not
in the paper.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy.sparse.csgraph import minimum_spanning_tree
from scipy.spatial.distance import cdist

from nsf.data.normalize import deviation
from nsf.dynamics import ReducedMPM
from nsf.progress import Progress
from nsf.recurrence.solids import FEATURES, collider_states

#: Of the distances between training trajectories: the largest ones are of single frames.
QUANTILE = 0.95
#: A calibration run gone astray must not vouch for others: beyond this many medians it does not count.
STRAY = 2.0
#: Of a value: what float32 may have moved it by.
_ROUND_OFF = 1e-6
#: Of how far the extreme one of training's programs stands out: a new one of the kind may stand out further.
_AGAIN = 2.0
_ROWS = 256  # steps decoded, and held with their distances to all training snapshots, at once


class LatentDistance:
    """How far latent vectors are from the training latents, as a distance of the sample particles [m].

    The RMS distance of g(X_S, x̂) to the nearest g(X_S, x̂_train). Between latents of unit variance a
    component that hardly moves anything would count as much as the first.

    Args:
        manifold: trained fields.
        particles: [s] indices of S, of all phases.
        device: torch device.
    """

    def __init__(self, manifold, particles: np.ndarray, device: str | torch.device = "cpu"):
        self._at = manifold.restrict(particles=torch.as_tensor(particles), device=device)
        self._latents = manifold.training_latents
        training = self._positions(manifold.training_latents)
        self._origin = training.mean(0)  # near which distances lose fewer digits
        self._training = training - self._origin
        self._trajectories = manifold.training_trajectories.to(device)

    def of(self, xhat: np.ndarray) -> np.ndarray:
        """Distance [n] [m] of latent vectors [n, r] to the nearest training latent; NaN where x̂ is."""
        return _nearest(self._positions(torch.as_tensor(xhat)) - self._origin, self._training).cpu().numpy()

    def between_trajectories(self) -> np.ndarray:
        """[M] distance [m] of each training latent to the nearest of another trajectory; [0] if none."""
        distances = [np.zeros(0)]
        for k in self._trajectories.unique():
            inside = self._trajectories == k
            if not inside.all():
                distances.append(_nearest(self._training[inside], self._training[~inside]).cpu().numpy())
        return np.concatenate(distances)

    def embedded(self, error: float) -> tuple[np.ndarray, np.ndarray]:
        """The same distances between few numbers, where positions are modes times coefficients.

        Args:
            error: by which any distance between training latents may be off [m].

        Returns:
            [q, K]: distances of its products with coefficients a(x̂) are those of `of`; and [M, q], the
            products of the training latents.
        """
        modes = self._at.fields["deformation"].modes.flatten(0, 1).double().cpu().numpy()
        modes = modes / self._at.points**0.5
        a = self._coefficients(self._latents).cpu().numpy()
        R = np.linalg.qr(modes, mode="r")
        y = (a - a.mean(0)) @ R.T
        _, _, axes = np.linalg.svd(y, full_matrices=False)
        squares = (y @ axes.T) ** 2
        beyond = np.sqrt(np.cumsum(squares[:, ::-1], axis=1)[:, ::-1]).max(0)  # in this and further axes
        count = max(1, int((2.0 * beyond > error).sum()))
        matrix = axes[:count] @ R
        return matrix, a @ matrix.T

    def nearly(self, error: float) -> Callable[[torch.Tensor], torch.Tensor]:
        """`of` for many latent vectors [n, r], off by `error` [m] at most; [n] on their device.

        Where positions are modes times coefficients it takes a fraction of the time.
        """
        if not hasattr(self._at, "fields") or not hasattr(self._at.fields["deformation"], "modes"):
            return lambda xhat: torch.as_tensor(self.of(xhat.cpu().numpy())).to(xhat)
        matrix, training = (torch.as_tensor(a, device=self._at.device) for a in self.embedded(error))
        return lambda xhat: _nearest(self._coefficients(xhat) @ matrix.T, training)

    def _coefficients(self, latents: torch.Tensor) -> torch.Tensor:
        """a(x̂) [n, K] in fp64, of a field of modes times coefficients."""
        field, latents = self._at.fields["deformation"], latents.to(self._at.device, self._at.dtype)
        with torch.no_grad():
            closed = [] if field.network is None else [field.network(latents)]
        return torch.cat([latents, *closed], 1).double()

    def _positions(self, latents: torch.Tensor) -> torch.Tensor:
        """g(X_S, x̂) [n, 3 s] over √s: Euclidean distances of rows are RMS distances of particles."""
        latents = latents.to(self._at.device, self._at.dtype)
        with torch.no_grad():
            rows = [self._at.position(part).flatten(1) for part in latents.split(_ROWS)]
        return torch.cat(rows) / self._at.points**0.5


class CaseDistance:
    """How far a case is from the training cases, in units of their own spacing.

    Parameters are standardised over the training cases. Their spacing is the longest edge of their minimum
    spanning tree: the longest step that it takes to go from any case to any other by way of further ones.

    Args:
        manifold: trained fields.
    """

    def __init__(self, manifold):
        self._names = manifold.parameter_names
        self._values = np.unique(manifold.training_parameters.cpu().numpy(), axis=0)
        self._deviation = deviation(self._values)
        standard = self._values / self._deviation
        self._spacing = float(minimum_spanning_tree(cdist(standard, standard)).max()) or 1.0

    def of(self, case: Mapping[str, float]) -> float:
        """The ratio: the distance to the nearest training case, or 1 and the way into their box from outside.

        In one parameter it is at most 1/2 between the training values. 0 where nothing varies.
        """
        if not self._names:
            return 0.0
        at, low, high = [case[name] for name in self._names], self._values.min(0), self._values.max(0)
        beyond = np.maximum(np.maximum(low - at, at - high), 0.0)
        beyond = np.where(beyond > _ROUND_OFF * np.maximum(abs(low), abs(high)), beyond, 0.0)
        nearest = cdist([at / self._deviation], self._values / self._deviation).min()
        outside = float(np.linalg.norm(beyond / self._deviation))
        return max(float(nearest) / self._spacing, 1.0 + outside / self._spacing if outside else 0.0)

    def plain(self) -> dict:
        """The training cases, the deviation of each parameter among them, and their spacing."""
        return {
            "cases": self._values.tolist(),
            "deviation": self._deviation.tolist(),
            "spacing": self._spacing,
        }

    def extremes(self) -> list[dict[str, float]]:
        """First, middle and last training case along each parameter, without repetition."""
        count = len(self._values)
        rows = {
            int(order[at])
            for order in np.argsort(self._values, axis=0, kind="stable").T
            for at in (0, count // 2, count - 1)
        }
        return [dict(zip(self._names, self._values[row].tolist(), strict=True)) for row in sorted(rows)]


class SolidsRange:
    """How far solids leave the poses and speeds that programs of training gave them.

    Each number of a solid's state, shift [m], angle [rad] and both velocities, has its range over all
    training runs; it counts from the middle, in units of the half. A run that is drawn like them may go
    beyond by twice as much as the one of them that goes furthest beyond the ranges of the others. Ranges do
    not see numbers that are usual one by one and unusual together, as fast where it is deep.

    Args:
        states: [M, N, f] of training runs, as `collider_states` gives them; M of 1 leaves no leeway.
        dt: their step [s].
    """

    def __init__(self, states: np.ndarray, dt: float):
        rows = _velocities(states, dt)
        low, high = rows.min(1), rows.max(1)
        self._middle, self._half = _range(low, high)
        self._round_off = _ROUND_OFF * np.abs(rows).max((0, 1))
        beyond = [1.0]
        for run in range(len(rows)) if len(rows) > 1 else ():
            without = _range(np.delete(low, run, 0), np.delete(high, run, 0))
            ratios = self._of(rows[run], *without)
            beyond.append(float(ratios[np.isfinite(ratios)].max(initial=1.0)))
        self._leeway = 1.0 + _AGAIN * (max(beyond) - 1.0)

    def of(self, states: np.ndarray, dt: float) -> np.ndarray:
        """The ratio [...] of states [..., f] in steps of dt [s]; above 1 no training run was like it."""
        return self._of(_velocities(states, dt), self._middle, self._half).max(-1, initial=0.0) / self._leeway

    def _of(self, rows: np.ndarray, middle: np.ndarray, half: np.ndarray) -> np.ndarray:
        distance = np.maximum(np.abs(rows - middle) - self._round_off, 0.0)
        return np.divide(distance, half, out=np.where(distance > 0.0, np.inf, 0.0), where=half > 0.0)


def _range(low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Middle and half [f] of what runs reach at least and at most [M, f]."""
    return 0.5 * (high.max(0) + low.min(0)), 0.5 * (high.max(0) - low.min(0))


def _velocities(states: np.ndarray, dt: float) -> np.ndarray:
    """States [..., f] with velocities in place of changes in a step."""
    rows = states.reshape(*states.shape[:-1], -1, FEATURES).copy()
    rows[..., 4:8] /= dt
    return rows.reshape(states.shape)


@dataclass(frozen=True)
class Trust:
    """The estimate, calibrated on training data.

    Attributes:
        residual: scale of projection residuals [m].
        distance: scale of the latent distance [m].
        latent_distance: the distance itself.
        cases: distance from the training cases.
        gravity: middle [3] and radius [m/s²] of what programs of training may give; None without any.
        solids: what programs of training did with solids; None where they move none.
    """

    residual: float
    distance: float
    latent_distance: LatentDistance
    cases: CaseDistance
    gravity: tuple[Sequence[float], float] | None = None
    solids: SolidsRange | None = None

    @classmethod
    def calibrated(
        cls,
        latent_distance: LatentDistance,
        cases: CaseDistance,
        runs: Sequence[tuple[np.ndarray, np.ndarray]],
    ) -> Trust:
        """From reduced runs of training cases.

        The residual's scale is the largest that these runs leave; but at most `STRAY` times the median of
        each run's largest, as a run of a training case may go astray too. The distance's is how far these
        runs go by the same rule, or the `QUANTILE` of what separates each training trajectory from the
        others where that is more.

        Args:
            latent_distance: distance from the training latents.
            cases: distance from the training cases.
            runs: x̂ [N + 1, r] and residuals [N] [m] of each run, as for `ratios`, as far as it went well;
                none where no run takes projected steps, so that distances alone count.
        """
        distances = latent_distance.between_trajectories()
        separation = float(np.quantile(distances, QUANTILE)) if len(distances) else 0.0
        drift = _largest([latent_distance.of(xhat) for xhat, _ in runs])
        residual = _largest([residuals for _, residuals in runs])
        return cls(residual, max(separation, drift), latent_distance, cases)

    def ratios(self, xhat: np.ndarray, residuals: np.ndarray) -> np.ndarray:
        """The larger of residual and distance over its scale, at each step; ∞ where a value is not finite.

        Args:
            xhat: [N + 1, r] latent vectors.
            residuals: [N] projection residuals after the last iteration [m]; none at t = 0.

        Returns:
            [N + 1] dimensionless; above 1 the step is not to be believed.
        """
        residual = np.concatenate([[0.0], residuals]) / self.residual
        # Not np.fmax: a value that is not finite must not hide behind the other.
        ratios = np.maximum(residual, self.latent_distance.of(xhat) / self.distance)
        return np.nan_to_num(ratios, nan=np.inf, posinf=np.inf)

    def of_forcing(self, gravity: np.ndarray, solids: np.ndarray, dt: float) -> np.ndarray:
        """How far what forces a run is outside of what programs of training do.

        Args:
            gravity: [..., 3] at the start of each step [m/s²].
            solids: [..., f] state of the solids there, as `collider_states` gives it; dt: step [s].

        Returns:
            [...] distance from the middle over the radius or half of the range, where that is above 1; else
            0, since a forcing that is inside tells nothing of where the run goes.
        """
        ratios = np.zeros(gravity.shape[:-1])
        if self.gravity is not None:
            middle, radius = self.gravity
            ratios = np.linalg.norm(gravity - np.asarray(middle), axis=-1) / radius
        if self.solids is not None:
            ratios = np.maximum(ratios, self.solids.of(solids, dt))
        return np.where(ratios > 1.0 + _ROUND_OFF, ratios, 0.0)

    def of_forcing_in(self, run: ReducedMPM, first: int = 0) -> np.ndarray:
        """`of_forcing` at the steps of a run from a first one on, each with the forcing of its start."""
        steps, dt = run.steps_taken, run.together.dt
        colliders = run.together.batch.forcing.colliders_of(run.index)
        solids = collider_states(colliders, dt, steps)[first:]
        return self.of_forcing(run.acting_gravity(dt * np.arange(first, steps)), solids, dt)

    def of_run(self, run: ReducedMPM, diverged: int | None = None) -> np.ndarray:
        """All signals of a run together, [n + 1] over the steps taken; above 1 a step is not to be believed.

        Args:
            run: at its end, or in its midst.
            diverged: step at which it diverged and from which on the ratio is ∞; −1: at none. None: to be
                found.
        """
        latent = run.trajectory()
        ratios = self.ratios(latent.xhat, latent.residuals[:, -1])
        # Not below 1: there the steps themselves tell more.
        for outside in (run.doubt[0], self.cases.of(run.setup.values)):
            if outside > 1.0:
                ratios = np.maximum(ratios, outside)
        ratios[1:] = np.maximum(ratios[1:], self.of_forcing_in(run))
        diverged = run.left_grid() if diverged is None else diverged
        if diverged >= 0:
            ratios[diverged:] = np.inf
        return ratios


def calibrate(
    solver_at: Callable[[Mapping[str, float], str], ReducedMPM], manifold, device: str, projects: bool = True
) -> Trust:
    """The estimate of trust, from reduced runs of the first, the middle and the last training cases.

    Runs and not the snapshots' own residuals: what a step leaves at S depends on S, the method and Δt.

    Args:
        solver_at: case and device name → solver at t = 0.
        manifold: trained fields.
        device: `cpu`, `cuda` or `cuda:N`.
        projects: whether projected steps are taken, so that residuals count; else no run is made.
    """
    cases, runs = CaseDistance(manifold), []
    extremes = cases.extremes() if projects else cases.extremes()[:1]
    with Progress("calibrate", len(extremes), "runs") as progress:
        for case in extremes:
            solver = solver_at(case, device)
            if projects:
                solver.step(solver.total_steps)
                latent, diverged = solver.trajectory(), solver.left_grid()
                good = diverged if diverged >= 0 else len(latent.xhat)
                runs.append((latent.xhat[:good], latent.residuals[: good - 1, -1]))
            progress.advance()
    particles = np.unique(np.concatenate([span.particles for span in solver.samples]))
    return Trust.calibrated(LatentDistance(manifold, particles, device), cases, runs)


def first_distrusted(ratios: np.ndarray) -> int:
    """First step whose ratio [N + 1] exceeds 1; −1 when none does."""
    above = np.flatnonzero(ratios > 1.0)
    return int(above[0]) if len(above) else -1


def _nearest(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Distance [n] of each row of a [n, c] to the nearest row of b [m, c]."""
    return torch.cat([torch.cdist(rows, b).amin(1) for rows in a.split(_ROWS)])


def _largest(runs: list[np.ndarray]) -> float:
    """Largest value of all runs, at most `STRAY` medians of their own largest; never 0, since it divides."""
    tiny = float(np.finfo(float).tiny)
    if not runs:
        return tiny
    largest = [float(np.max(values, initial=tiny)) for values in runs]
    return min(max(largest), STRAY * float(np.median(largest)))
