"""Least squares: the parameters under which runs by operators pass the observations, and how sure they are.

Residuals are (y − m(θ))/s with s² = σ² + s_b²: σ of the measurement, and s_b the reduced model's own error
at the same points and times, as validation runs show it. An estimate is A y with A the pseudo-inverse of
the scaled Jacobian, so that both errors go through A into the covariance of the estimate,

    C = A diag(σ²/s²) Aᵀ + 1/V Σ_v δ_v δ_vᵀ,    δ_v = A b_v/s,

where b_v [m] is the model's error in validation run v, and δ_v how far it alone would put the estimate off.
Nothing is assumed of how b_v hangs together over points and times. V runs tell a variance with V degrees of
freedom, so that intervals are Student's, with those of Welch and Satterthwaite.
"""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy import stats
from scipy.optimize import least_squares
from scipy.stats import qmc
from torch import Tensor
from torch.autograd import forward_ad

from nsf.data import PROGRAM, Trajectory
from nsf.data.schema import TRAJECTORY
from nsf.errors import ConfigError, InstabilityError
from nsf.inverse.model import Model
from nsf.inverse.observations import View

#: Share of the truths that an interval is to hold.
CONFIDENCE = 0.9
#: Deviation of a value of which nothing is known but its range, in units of the range.
_UNKNOWN = 12.0**-0.5
#: Entry of a direction's unit vector from which on a parameter is named as part of it.
_PART = 0.3
_POLISHED = 3  # starts that are followed to their end
_FEWEST = 2  # validation runs
_STOPS = {
    0: "evaluations used up", 1: "gradient vanishes", 2: "residuals change no more",
    3: "parameters change no more", 4: "residuals and parameters change no more",
}  # fmt: skip


@dataclass(frozen=True)
class Space:
    """The parameters that are sought, in units of their ranges; those that are known.

    Attributes:
        model: whose they are.
        free: names; ranges: [n, 2] theirs; log: [n] whether they are taken evenly in their logarithm.
        fixed: values of the others, by name.
    """

    model: Model
    free: tuple[str, ...]
    ranges: np.ndarray
    log: np.ndarray
    fixed: Mapping[str, float]

    @classmethod
    def of(cls, model: Model, asked: Mapping[str, Sequence[float] | float] | None = None) -> "Space":
        """Ranges, or values that are known, by name; what was taught of the others.

        Raises:
            ConfigError: a name is unknown, nothing is left to seek, or a range goes beyond what was taught.
        """
        asked = dict(asked or {})
        if unknown := [name for name in asked if name not in model.names]:
            raise ConfigError(f"there is no parameter {unknown[0]!r}; there are {', '.join(model.names)}")
        taught = dict(zip(model.names, model.ranges.tolist(), strict=True))
        fixed = {name: float(value) for name, value in asked.items() if np.ndim(value) == 0}
        ranges = {
            name: list(map(float, asked.get(name, taught[name]))) for name in taught if name not in fixed
        }
        for name, (low, high) in [*ranges.items(), *((name, (v, v)) for name, v in fixed.items())]:
            least, most = taught[name]
            slack = 1e-9 * max(abs(least), abs(most))
            if not least - slack <= low <= high <= most + slack:
                raise ConfigError(
                    f"{name}={low:g}..{high:g} goes beyond what was taught, {least:g}..{most:g}; stay "
                    f"within, "
                    "or train with a wider range"
                )
        if empty := [name for name, (low, high) in ranges.items() if low == high]:
            raise ConfigError(f"{empty[0]} has an empty range; give {empty[0]}={ranges[empty[0]][0]:g}")
        if not ranges:
            raise ConfigError("every parameter is given; leave out one that is to be found")
        log = np.array([model.scene.parameters[name].log for name in ranges])
        return cls(model, tuple(ranges), np.array(list(ranges.values())), log, fixed)

    def parameters(self, u: Tensor) -> Tensor:
        """All parameters [..., n] of those sought, u [..., free] in units of their ranges."""
        own = dict(zip(self.free, self.values(u).unbind(-1), strict=True))
        every = [
            own.get(name, torch.full_like(u[..., 0], self.fixed.get(name, 0.0))) for name in self.model.names
        ]
        return torch.stack(every, -1)

    def values(self, u: Tensor) -> Tensor:
        """Values [..., free] of u."""
        low, high = torch.as_tensor(self.ranges).to(u).unbind(1)
        log = torch.as_tensor(self.log).to(u.device)
        even = low + u * (high - low)
        safe_low, safe_high = (torch.where(log, end, torch.ones_like(end)) for end in (low, high))
        return torch.where(log, safe_low * (safe_high / safe_low) ** u, even)

    def units(self, values: np.ndarray) -> np.ndarray:
        """u [free] of values."""
        low, high = self.ranges.T
        even = (np.asarray(values, float) - low) / (high - low)
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.where(self.log, np.log(values / low) / np.log(high / low), even)


@dataclass(frozen=True)
class ModelError:
    """How far runs by operators are from full-order runs at the observations, in validation cases.

    Attributes:
        vectors: [V, m] [m].
    """

    vectors: np.ndarray

    @classmethod
    def of(cls, view: View, model: Model) -> "ModelError":
        """From the validation runs of the model's chain.

        Raises:
            ConfigError: there are too few.
        """
        pipeline, found = model.pipeline, []
        for case in pipeline.split.validation:
            run = pipeline.simulation(case)
            if not run.complete:
                continue
            forcing = model.forcing(case.parameters, int(case[PROGRAM])) if PROGRAM in case else None
            with torch.no_grad():
                seen = view.of_runs(model(model.tensor(case.parameters)[None], forcing))[0].cpu().numpy()
            with Trajectory.open(run.file(TRAJECTORY)) as trajectory:
                found.append(view.of_truth(trajectory) - seen)
        if len(found) < _FEWEST:
            raise ConfigError(
                f"{len(found)} validation runs cannot tell the model's own error, and intervals without "
                f"it miss "
                f"the truth; give scene.design.validation at least {_FEWEST} values, better 8, in `nsf run`"
            )
        return cls(np.array(found))

    @property
    def deviations(self) -> np.ndarray:
        """[m] root mean square over the runs [m]."""
        return np.sqrt(np.mean(self.vectors**2, axis=0))


@dataclass(frozen=True)
class Fit:
    """What was found.

    Attributes:
        space: of the parameters; u: [n] the estimate in units of the ranges.
        estimate, standard_error, lower, upper: [n] values; the last two hold the truth in 90 % of the cases.
        covariance: [n, n] of u.
        seen: [m] the observations in the fitted run [m]; residuals: [m] in units of s.
        scale: [m] s [m].
        share: [n] of the variance that is the model's own error.
        freedom: [n] degrees of freedom of the intervals.
        xhat: [N + 1, r] the fitted run; distrust: its ratio.
        stops: why each start that was followed ended, the best first; starts: how many were looked at.
        project: [n, m] A/s, from observations [m] to u.
        seconds: wall time.
    """

    space: Space
    u: np.ndarray
    estimate: np.ndarray
    standard_error: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    covariance: np.ndarray
    seen: np.ndarray
    residuals: np.ndarray
    scale: np.ndarray
    share: np.ndarray
    freedom: np.ndarray
    xhat: np.ndarray
    distrust: float
    stops: tuple[str, ...]
    starts: int
    project: np.ndarray
    seconds: float

    @property
    def correlation(self) -> np.ndarray:
        """[n, n] of the estimate's errors."""
        deviation = np.sqrt(np.diag(self.covariance))
        return self.covariance / np.outer(deviation, deviation)

    @property
    def at_end(self) -> list[str]:
        """Parameters whose estimate is at an end of their range, where the truth may lie outside."""
        return [name for name, u in zip(self.space.free, self.u, strict=True) if min(u, 1.0 - u) < 1e-6]


def fit(
    view: View,
    model: Model,
    space: Space | None = None,
    error: ModelError | None = None,
    starts: int = 64,
    forcing=None,
) -> Fit:
    """The parameters whose run passes the observations best.

    Args:
        view: of the observations.
        model: of the runs.
        space: where to look; all that was taught by default.
        error: the model's own; from the validation runs by default.
        starts: points of the space that are looked at in one batch, from the best of which the fit goes on.
        forcing: of the run that was observed; the scene's own by default.

    Raises:
        ConfigError: there are fewer observations than parameters, or they cannot tell some apart.
        InstabilityError: no start gives a run that stays finite.
    """
    began = time.perf_counter()
    space = space or Space.of(model)
    error = error or ModelError.of(view, model)
    own = view.observations
    if len(own) < len(space.free):
        raise ConfigError(
            f"{len(own)} observations cannot tell {len(space.free)} parameters, {', '.join(space.free)}; "
            f"observe "
            "more, or give one of them as NAME=VALUE"
        )
    s = np.sqrt(own.deviations**2 + error.deviations**2)

    def seen(u: Tensor) -> Tensor:
        return view.of_runs(model(space.parameters(u), forcing))

    def residuals(u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        values, slopes = with_jacobian(seen, torch.as_tensor(u, device=model.device)[None])
        return (values[0].cpu().numpy() - own.values) / s, slopes[0].cpu().numpy() / s[:, None]

    first = _best_starts(seen, own.values, s, len(space.free), starts, model.device)
    found = sorted((_followed(residuals, u) for u in first), key=lambda result: result.cost)
    best = found[0]
    J = best.jac
    _check_told_apart(J, space)
    A = np.linalg.pinv(J)
    noise = (A * (own.deviations / s) ** 2) @ A.T
    off = (error.vectors / s) @ A.T
    V = len(off)
    of_model = off.T @ off / V
    covariance = noise + of_model
    share = np.diag(of_model) / np.diag(covariance)
    freedom = V / np.maximum(share**2, 1e-12)  # Welch 1947: the measurement's variance is known
    deviation = np.sqrt(np.diag(covariance))
    reach = stats.t.ppf(0.5 + 0.5 * CONFIDENCE, freedom) * deviation
    with torch.no_grad():
        mu = space.parameters(torch.as_tensor(best.x, device=model.device))
        xhat = model(mu, forcing)
        distrust = float(model.distrust(xhat, mu, forcing))

    def valued(u: np.ndarray) -> np.ndarray:
        return space.values(torch.as_tensor(u)).numpy()

    slope = np.abs(with_jacobian(space.values, torch.as_tensor(best.x)[None])[1][0].numpy().diagonal())
    return Fit(
        space=space,
        u=best.x,
        estimate=valued(best.x),
        standard_error=slope * deviation,
        lower=valued(best.x - reach),
        upper=valued(best.x + reach),
        covariance=covariance,
        seen=best.fun * s + own.values,
        residuals=best.fun,
        scale=s,
        share=share,
        freedom=freedom,
        xhat=xhat.cpu().numpy(),
        distrust=distrust,
        stops=tuple(_STOPS.get(result.status, "failed") for result in found),
        starts=starts,
        project=A / s,
        seconds=time.perf_counter() - began,
    )


def with_jacobian(of, u: Tensor) -> tuple[Tensor, Tensor]:
    """Values [B, m] of a function of rows u [B, n], and their derivatives [B, m, n], in one pass forward."""
    B, n = u.shape
    rows = u[:, None].expand(B, n, n).reshape(-1, n)
    ways = torch.eye(n, dtype=u.dtype, device=u.device).expand(B, n, n).reshape(-1, n)
    with torch.no_grad(), forward_ad.dual_level():
        values, slopes = forward_ad.unpack_dual(of(forward_ad.make_dual(rows, ways.contiguous())))
    slopes = torch.zeros_like(values) if slopes is None else slopes
    return values.view(B, n, -1)[:, 0], slopes.view(B, n, -1).transpose(1, 2)


def _best_starts(seen, values: np.ndarray, s: np.ndarray, n: int, starts: int, device) -> list[np.ndarray]:
    """Points [n] of the unit cube with the least residuals, of so many that are evenly spread."""
    power = max(0, starts - 1).bit_length()
    cube = qmc.Sobol(n, seed=0).random_base2(power)[:starts]
    with torch.no_grad():
        found = seen(torch.as_tensor(cube, device=device)).cpu().numpy()
    costs = np.nansum(((found - values) / s) ** 2, axis=1)
    costs[~np.isfinite(found).all(1)] = np.inf
    order = np.argsort(costs)
    if not np.isfinite(costs[order[0]]):
        raise InstabilityError(
            "no run of the ranges stays finite; choose smaller ranges, or teach again with more "
            "engine.teaching.steps"
        )
    # Those beside a better one would end where it ends.
    reach, chosen = 1.5 * starts ** (-1.0 / n), []
    for i in order[np.isfinite(costs[order])]:
        if all(np.abs(cube[i] - other).max() > reach for other in chosen):
            chosen.append(cube[i])
        if len(chosen) == _POLISHED:
            break
    return chosen


def _followed(residuals, u: np.ndarray):
    """scipy's least squares from a start, within the ranges."""
    known: dict[bytes, tuple[np.ndarray, np.ndarray]] = {}

    def both(at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        if at.tobytes() not in known:
            known.clear()
            known[at.tobytes()] = residuals(at)
        return known[at.tobytes()]

    # A step that leaves what is finite is no step down: it gets residuals that are too large to take.
    def finite(at: np.ndarray) -> np.ndarray:
        return np.nan_to_num(both(at)[0], nan=1e6, posinf=1e6, neginf=-1e6)

    return least_squares(
        finite, u, jac=lambda at: np.nan_to_num(both(at)[1]), bounds=(0.0, 1.0), x_scale=1.0, max_nfev=40,
        xtol=1e-7, ftol=1e-7, gtol=1e-7,
    )  # fmt: skip


def _check_told_apart(J: np.ndarray, space: Space) -> None:
    """Refuse parameters that could be anywhere in their ranges for all that the observations say.

    Args:
        J: [m, n] scaled Jacobian; a right singular vector is a direction of the space, and its singular value
            the inverse of the estimate's deviation along it.
    """
    _, sizes, ways = np.linalg.svd(J, full_matrices=False)
    for size, way in zip(sizes, ways, strict=True):
        if size * _UNKNOWN <= 1.0:
            parts = [name for name, part in zip(space.free, way, strict=True) if abs(part) > _PART]
            told = (
                f"do not tell {parts[0]}" if len(parts) == 1 else f"do not tell {' and '.join(parts)} apart"
            )
            raise ConfigError(
                f"the observations {told}: they hardly change where {_along(space, way)}; observe other "
                f"points or "
                f"times, or give {parts[0]}=VALUE"
            )


def _along(space: Space, way: np.ndarray) -> str:
    """A direction of the space in words."""
    way = way * np.sign(way[np.abs(way).argmax()])
    parts = [(name, part) for name, part in zip(space.free, way, strict=True) if abs(part) > _PART]
    return " and ".join(f"{name} {'grows' if part > 0 else 'falls'}" for name, part in parts)
