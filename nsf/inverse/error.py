"""How far runs by operators are from full-order runs at what was observed, as validation runs show it."""

from dataclasses import dataclass

import numpy as np
import torch

from nsf.data import PROGRAM, Trajectory
from nsf.data.schema import TRAJECTORY
from nsf.errors import ConfigError
from nsf.inverse.derivatives import with_jacobian
from nsf.inverse.model import Forcing, Model
from nsf.inverse.observations import View
from nsf.inverse.space import UNKNOWN, Space

_FEWEST = 2  # validation runs
#: Of a parameter's range: how far validation runs tell much of the error at an estimate.
_NEAR = 0.25


@dataclass(frozen=True)
class ModelError:
    """What full-order runs of the validation cases have that runs by operators lack.

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
            own = [model.forcing(case.parameters, int(case[PROGRAM])) for case in cases]
            forcing = Forcing(*(torch.stack([getattr(f, k) for f in own]) for k in ("gravity", "solids")))
        with torch.no_grad():
            seen = view.of_runs(model(parameters, forcing)).cpu().numpy()
        truths = []
        for case in cases:
            with Trajectory.open(pipeline.simulation(case).file(TRAJECTORY)) as trajectory:
                truths.append(view.of_truth(trajectory))
        return cls(parameters, np.array(truths) - seen, forcing)

    @property
    def deviations(self) -> np.ndarray:
        """[m] root mean square over the runs [m]."""
        return np.sqrt(np.mean(self.vectors**2, axis=0))

    def offsets(self, view: View, model: Model, space: Space, scale: np.ndarray) -> "Offsets":
        """How far off the model's error alone puts an estimate at each validation case.

        By the slopes at that case: δ_v = (JᵀJ + 1/u₀²)⁻¹ Jᵀ b_v/s, with u₀ the deviation of a parameter of
        which nothing is known but its range.

        Args:
            view, model, space: of the estimate.
            scale: s [m].
        """
        V, n = len(self.parameters), len(space.free)
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
        normal = np.einsum("vmi,vmj->vij", J, J) + np.eye(n) / UNKNOWN**2
        off = np.linalg.solve(normal, np.einsum("vmi,vm->vi", J, self.vectors / scale)[..., None])[..., 0]
        return Offsets(u, off.reshape(V, n))


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

        Of one that is yet to come: that the mean is told by few cases is part of the covariance. Cases count
        by w ∝ exp(−|u_v − u|²/2h²), Σw = 1, h a quarter of the ranges; they are as many as 1/Σw² that count
        alike (Kish 1965).
        """
        far = np.sum((self.u - u) ** 2, axis=1)
        w = np.exp(-0.5 * (far - far.min()) / _NEAR**2)
        w /= w.sum()
        shared = float(np.sum(w**2))
        mean = w @ self.off
        about = self.off - mean
        covariance = (about * w[:, None]).T @ about / (1.0 - shared) * (1.0 + shared)
        return mean, covariance, 1.0 / shared - 1.0
