"""Least squares: the parameters under which runs by recurrence pass the observations, and how sure they are.

Residuals are (y − m(θ))/s with s² = σ² + s_b²: σ of the measurement, and s_b the reduced model's own error
at the same points and times, as validation runs show it. In validation run v that error, b_v [m], alone
would put the parameters off by δ_v = A_v b_v/s, with A_v the pseudo-inverse of the scaled Jacobian there, as
A is that of the Jacobian at the estimate. The ranges end both, and nothing draws either to their middle. So
the estimate is the parameters that fit best less what the δ_v have there on average, and its covariance

    C = A diag(σ²/s²) Aᵀ + cov δ,

with cov δ of the δ_v about their average, by a plane that is fitted to those nearest (`nsf.inverse.error`).
Nothing is assumed of how b_v hangs together over points and times. As few runs tell cov δ, intervals are
Student's, with the degrees of freedom of Welch and Satterthwaite.
"""

import time
from dataclasses import dataclass

import numpy as np
import torch
from scipy import stats
from torch import Tensor

from nsf.errors import ConfigError, InstabilityError
from nsf.inverse.error import ModelError
from nsf.inverse.model import Forcing, Model
from nsf.inverse.observations import View
from nsf.inverse.recurrence import with_jacobian
from nsf.inverse.search import nearest
from nsf.inverse.space import UNKNOWN, Space

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
