"""How far runs by recurrence are from full-order runs at what was observed, as validation runs show it."""

from dataclasses import dataclass

import numpy as np
import torch
from scipy.optimize import brentq

from nsf.data import PROGRAM, Trajectory
from nsf.errors import ConfigError
from nsf.inverse.model import Forcing, Model
from nsf.inverse.observations import View
from nsf.inverse.recurrence import with_jacobian
from nsf.inverse.space import Space

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
