"""Least squares: the parameters under which runs by recurrence pass the observations, and how sure they are.

Residuals are (y − m(θ))/s with s² = σ² + s_b²: σ of the measurement, and s_b the reduced model's own error
at the same points and times, as validation runs show it. In validation run v that error, b_v [m], alone
would put the parameters off by δ_v = A_v b_v/s, with A_v the pseudo-inverse of the scaled Jacobian there, as
A is that of the Jacobian at the estimate. The ranges end both, and nothing draws either to their middle. So
the estimate is the parameters that fit best less what the δ_v have there on average, and its covariance

    C = A diag(σ²/s²) Aᵀ + cov δ,

with cov δ of the δ_v about their average, by a plane that is fitted to those nearest (`Offsets`).
Nothing is assumed of how b_v hangs together over points and times. As few runs tell cov δ, intervals are
Student's, with the degrees of freedom of Welch and Satterthwaite.
"""

import time
from dataclasses import dataclass

import numpy as np
import torch
from scipy import stats
from scipy.optimize import brentq
from torch import Tensor

from nsf.data import PROGRAM, Trajectory
from nsf.errors import ConfigError, InstabilityError
from nsf.inverse.model import Forcing, Model
from nsf.inverse.observations import View
from nsf.inverse.recurrence import with_jacobian
from nsf.inverse.search import nearest
from nsf.inverse.space import UNKNOWN, Space

_FEWEST = 2  # validation runs
#: Of the validation runs, the share that tells of the error at an estimate.
_SHARE = 0.75
_FREEDOM = 2.0  # degrees that a plane has to leave


@dataclass(frozen=True)
class ModelError:
    """Differences of full-order runs of the validation cases from runs by recurrence.

    Attributes:
        parameters: [V, n] of the cases.
        vectors: [V, m] at the observations [m].
        forcing: of each run, where the runs follow programs.
    """

    parameters: np.ndarray
    vectors: np.ndarray
    forcing: Forcing | None = None

    @classmethod
    def of(cls, view: View, model: Model) -> "ModelError":
        """From the validation runs of the model's chain.

        Raises:
            ConfigError: there are too few.
        """
        pipeline = model.pipeline
        cases = [case for case in pipeline.split.validation if pipeline.simulation(case).complete]
        if len(cases) < _FEWEST:
            raise ConfigError(
                f"{len(cases)} validation runs cannot tell the model's own error, and intervals without it "
                f"miss the truth; give scene.design.validation at least {_FEWEST} cases, better 8"
            )
        parameters, forcing = np.array([[case[name] for name in model.names] for case in cases]), None
        if PROGRAM in cases[0]:
            runs = [model.forcing(case.parameters, int(case[PROGRAM])) for case in cases]
            forcing = Forcing(*(torch.stack([getattr(f, k) for f in runs]) for k in ("gravity", "solids")))
        with torch.no_grad():
            seen = view.of_runs(model(parameters, forcing)).cpu().numpy()
        truths = []
        for case in cases:
            with Trajectory.of(pipeline.simulation(case)) as trajectory:
                truths.append(view.of_truth(trajectory))
        return cls(parameters, np.array(truths) - seen, forcing)

    @property
    def deviations(self) -> np.ndarray:
        """[m] root mean square over the runs [m]."""
        return np.sqrt(np.mean(self.vectors**2, axis=0))

    def offsets(self, view: View, model: Model, space: Space, scale: np.ndarray) -> "Offsets":
        """How far off the model's error alone puts an estimate at each validation case.

        By the slopes at that case: δ_v = J⁺ b_v/s, with the pseudo-inverse that an estimate has too. Like an
        estimate over all that was taught it stays within the ranges, and nothing else holds it.

        Args:
            view, model, space: of the estimate.
            scale: s [m].
        """
        n = len(space.free)
        columns = [model.names.index(name) for name in space.free]
        u = space.units(self.parameters[:, columns])
        mu = model.tensor(self.parameters).repeat_interleave(n, 0)
        forcing = self.forcing and Forcing(
            *(values.repeat_interleave(n, 0) for values in (self.forcing.gravity, self.forcing.solids))
        )
        fixed = [mu[:, k] for k in range(mu.shape[1])]

        def seen(rows: torch.Tensor) -> torch.Tensor:
            every = list(fixed)
            for column, values in zip(columns, space.values(rows).unbind(-1), strict=True):
                every[column] = values
            return view.of_runs(model(torch.stack(every, -1), forcing))

        J = with_jacobian(seen, torch.as_tensor(u, device=model.device))[1].cpu().numpy() / scale[:, None]
        off = np.einsum("vnm,vm->vn", np.linalg.pinv(J), self.vectors / scale)
        low, high = space.units(model.ranges[columns].T)
        return Offsets(u, np.clip(u + off, np.minimum(low, u), np.maximum(high, u)) - u)


@dataclass(frozen=True)
class Offsets:
    """How far off estimates are at some places for the model's error alone, in units of the ranges.

    Attributes:
        u: [V, n] places; off: [V, n].
    """

    u: np.ndarray
    off: np.ndarray

    def near(self, u: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        """Mean [n], covariance [n, n] and degrees of freedom of what an estimate at a place u [n] is off.

        The mean is what a plane has at u that is fitted to the cases, those near u first: by weights
        w ∝ exp(−|u_v − u|²/2h²), Σw = 1, that as many cases share as three quarters of all would alike,
        1/Σw² = 3V/4 (Kish 1965). The covariance is about that plane, of one estimate that is yet to come;
        that few cases tell the plane is part of it. Of hardly more cases than parameters it is the mean.

        Source: Cleveland 1979 (locally weighted regression).
        """
        V, n = self.off.shape
        w = _weights(np.sum((self.u - u) ** 2, axis=1), _SHARE * V)
        shared = float(np.sum(w**2))
        rows = np.ones((V, 1))
        if 1.0 / shared - 1.0 - n >= _FREEDOM:
            rows = np.column_stack([rows, self.u - u])
        solve = np.linalg.pinv((rows * w[:, None]).T @ rows) @ (rows * w[:, None]).T
        about = np.eye(V) - rows @ solve
        left = about @ self.off
        covariance = (left * w[:, None]).T @ left / np.sum(w[:, None] * about**2)
        wider = 1.0 + float(np.sum(solve[0] ** 2))
        return solve[0] @ self.off, wider * covariance, max(1.0 / shared - rows.shape[1], 1.0)


def _weights(squares: np.ndarray, count: float) -> np.ndarray:
    """Gaussian weights [V] of squared distances [V] that `count` cases share."""

    def weights(log_width: float) -> np.ndarray:
        w = np.exp(-0.5 * (squares - squares.min()) / np.exp(log_width))
        return w / w.sum()

    ends = [1.0 / np.sum(weights(end) ** 2) - count for end in (-20.0, 20.0)]
    if ends[0] * ends[1] >= 0.0:  # as where all are equally near
        return weights(20.0)
    return weights(brentq(lambda width: 1.0 / np.sum(weights(width) ** 2) - count, -20.0, 20.0))


#: Share of the truths that an interval is to hold.
CONFIDENCE = 0.9
#: Entry of a direction's unit vector from which on a parameter is named as part of it.
_PART = 0.3


@dataclass(frozen=True)
class Fit:
    """The fitted parameters and their run.

    Attributes:
        space: of the parameters; u: [n] the estimate in units of the ranges.
        fitted: [n] values of the parameters whose run passes the observations best.
        estimate, standard_error, lower, upper: [n] values; the last two hold the truth in 90 % of the cases.
        covariance: [n, n] of u.
        seen: [m] the observations in the fitted run [m]; residuals: [m] in units of s.
        scale: [m] s [m].
        share: [n] of the variance that is the model's own error.
        freedom: [n] degrees of freedom of the intervals.
        xhat: [N + 1, r] the fitted run; error_bound: of it, a share of its displacement; limit: above
            which it is not to be believed.
        project: [n, m] A/s, from observations [m] to u.
        seconds: wall time.
    """

    space: Space
    u: np.ndarray
    fitted: np.ndarray
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
    error_bound: float
    limit: float
    project: np.ndarray
    seconds: float

    @property
    def correlation(self) -> np.ndarray:
        """[n, n] of the estimate's errors."""
        deviation = np.sqrt(np.diag(self.covariance))
        return self.covariance / np.outer(deviation, deviation)

    @property
    def misfit(self) -> float:
        """Root mean square of the residuals, by the degrees of freedom; about 1 where all is as stated."""
        return float(np.sqrt(np.sum(self.residuals**2) / max(1, len(self.residuals) - len(self.u))))

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
    forcing: Forcing | None = None,
) -> Fit:
    """The parameters whose run passes the observations best.

    Args:
        view: of the observations.
        model: of the runs.
        space: where to look; all that was taught by default.
        error: the model's own; from the validation runs by default.
        starts: points of the space to begin at; see `nsf.inverse.search`.
        forcing: of the run that was observed; the scene's own by default.

    Raises:
        ConfigError: there are fewer observations than parameters, or they cannot tell some apart.
        InstabilityError: no start gives a run that stays finite.
    """
    began = time.perf_counter()
    space = space or Space.of(model)
    error = error or ModelError.of(view, model)
    observations = view.observations
    if len(observations) < len(space.free):
        raise ConfigError(
            f"{len(observations)} observation{'s' * (len(observations) != 1)} cannot tell {len(space.free)} "
            f"parameters, {', '.join(space.free)}; observe more, or give one of them as NAME=VALUE"
        )
    s = np.sqrt(observations.deviations**2 + error.deviations**2)

    def seen(u: Tensor) -> Tensor:
        return view.of_runs(model(space.parameters(u), forcing))

    best = nearest(seen, observations.values, s, len(space.free), starts, model.device)
    if best is None:
        raise InstabilityError(
            "no run of the ranges stays finite; choose smaller ranges, or teach again with more model.runs"
        )
    J = best.jac
    _check_told_apart(J, space)
    A = np.linalg.pinv(J)
    noise = (A * (observations.deviations / s) ** 2) @ A.T
    off, of_model, V = error.offsets(view, model, space, s).near(best.x)
    u = np.clip(best.x - off, 0.0, 1.0)
    covariance = noise + of_model
    share = np.diag(of_model) / np.diag(covariance)
    freedom = V / np.maximum(share**2, 1e-12)  # Welch 1947: the measurement's variance is known
    deviation = np.sqrt(np.diag(covariance))
    reach = stats.t.ppf(0.5 + 0.5 * CONFIDENCE, freedom) * deviation
    with torch.no_grad():
        mu = space.parameters(torch.as_tensor(best.x, device=model.device))
        xhat = model(mu, forcing)
        error_bound = float(model.error_bound(mu, forcing))

    def valued(u: np.ndarray) -> np.ndarray:
        return space.values(torch.as_tensor(u)).numpy()

    slope = np.abs(with_jacobian(space.values, torch.as_tensor(u)[None])[1][0].numpy().diagonal())
    return Fit(
        space=space,
        u=u,
        fitted=valued(best.x),
        estimate=valued(u),
        standard_error=slope * deviation,
        lower=valued(u - reach),
        upper=valued(u + reach),
        covariance=covariance,
        seen=best.fun * s + observations.values,
        residuals=best.fun,
        scale=s,
        share=share,
        freedom=freedom,
        xhat=xhat.cpu().numpy(),
        error_bound=error_bound,
        limit=model.trust.limit,
        project=A / s,
        seconds=time.perf_counter() - began,
    )


def _check_told_apart(J: np.ndarray, space: Space) -> None:
    """Refuse parameters that could be anywhere in their ranges for all that the observations say.

    Args:
        J: [m, n] scaled Jacobian; a right singular vector is a direction of the space, and its singular value
            the inverse of the estimate's deviation along it.
    """
    _, sizes, ways = np.linalg.svd(J, full_matrices=False)
    for size, way in zip(sizes, ways, strict=True):
        if size * UNKNOWN <= 1.0:
            parts = [name for name, part in zip(space.free, way, strict=True) if abs(part) > _PART]
            what = (
                f"do not tell {parts[0]}" if len(parts) == 1 else f"do not tell {' and '.join(parts)} apart"
            )
            raise ConfigError(
                f"the observations {what}: they hardly change where {_along(space, way)}; observe other "
                f"points or times, or give {parts[0]}=VALUE"
            )


def _along(space: Space, way: np.ndarray) -> str:
    """A direction of the space in words."""
    way = way * np.sign(way[np.abs(way).argmax()])
    parts = [(name, part) for name, part in zip(space.free, way, strict=True) if abs(part) > _PART]
    return " and ".join(f"{name} {'grows' if part > 0 else 'falls'}" for name, part in parts)
