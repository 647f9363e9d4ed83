"""Latent vectors of training runs, interpolated over the problem parameters: a model that takes no step."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from typing_extensions import override

from nsf.data.normalize import deviation
from nsf.errors import ConfigError
from nsf.models.inputs import Inputs, Lessons, Validation
from nsf.models.latent import LatentModel


@dataclass(frozen=True)
class TrainingRuns:
    """The latent vectors of the training trajectories, run by run.

    Attributes:
        parameters: [K, n] of each run, standardised over the runs; a parameter that never varies is 0. Where
            programs force the runs, columns of their forcing follow.
        latents: [K, F, r] of each frame.
    """

    parameters: np.ndarray
    latents: np.ndarray
    _mean: np.ndarray
    _deviation: np.ndarray

    @classmethod
    def of(cls, manifold, forcing: Sequence[np.ndarray] = ()) -> "TrainingRuns":
        """The runs that a manifold was trained on; all have the same frames.

        Args:
            manifold: trained fields.
            forcing: [D] of each run, as `nsf.evaluation.rivals.forcing_of` gives it; none where no program
                forces the runs.
        """
        run = manifold.training_trajectories.cpu().numpy()
        count = int(run[-1]) + 1
        latents = manifold.training_latents.cpu().double().numpy().reshape(count, -1, manifold.latent_dim)
        values = manifold.training_parameters.cpu().double().numpy()
        values = values.reshape(count, -1, values.shape[1])[:, 0]
        mean, spread = values.mean(0), deviation(values)
        if len(forcing):
            # A whole program weighs as much as one parameter.
            programs = np.stack(forcing)
            weight = np.linalg.norm(programs.std(0)) or 1.0
            values = np.hstack([values, programs])
            mean = np.concatenate([mean, programs.mean(0)])
            spread = np.concatenate([spread, np.full(programs.shape[1], weight)])
        return cls((values - mean) / spread, latents, mean, spread)

    def standardised(self, parameters: np.ndarray) -> np.ndarray:
        """Parameters [n] in the units of `self.parameters`."""
        return (np.asarray(parameters, float) - self._mean) / self._deviation

    def nearest(self, parameters: np.ndarray) -> np.ndarray:
        """[F, r] latent vectors of the training run whose parameters [n] are nearest; the first of equals."""
        distance = np.linalg.norm(self.parameters - self.standardised(parameters), axis=1)
        return self.latents[int(distance.argmin())]

    def interpolated(self, parameters: np.ndarray) -> np.ndarray:
        """[F, r] latent vectors, frame by frame interpolated over the training parameters.

        The radial basis function |p − q| makes it piecewise linear in one parameter, constant beyond the
        training values.
        """
        from scipy.interpolate import RBFInterpolator  # SciPy takes 0.2 s to load

        values = self.latents.reshape(len(self.latents), -1)
        fit = RBFInterpolator(self.parameters, values, kernel="linear", degree=0)
        return fit(self.standardised(parameters)[None]).reshape(self.latents.shape[1:])


@dataclass(frozen=True)
class Interpolate(LatentModel):
    """Interpolates training latents over the parameters; it knows no forcing.

    On a family of runs with few parameters, all forced alike, it can be nearer to the truth than any step.
    """

    knows_forcing = False

    @override
    def refuse(self, pipeline) -> None:
        super().refuse(pipeline)
        if pipeline.scene.forcing:
            raise ConfigError(
                f"model=interpolate knows no forcing, and programs force scene={pipeline.scene.name}; set "
                "model=projected, or model=recurrence"
            )

    @override
    def fit(self, manifold, lessons: Lessons, validation: Validation | None, seed: int) -> TrainingRuns:
        return TrainingRuns.of(manifold)

    @override
    def run(self, fitted: TrainingRuns, inputs: Inputs) -> np.ndarray:
        return np.stack([fitted.interpolated(values) for values in inputs.parameters])
