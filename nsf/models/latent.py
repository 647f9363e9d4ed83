"""Models that give the latent vectors of whole runs at once."""

from abc import abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from typing_extensions import override

from nsf.errors import ConfigError
from nsf.models.base import Model
from nsf.models.inputs import Inputs, Lessons, Validation


@dataclass(frozen=True)
class LatentModel(Model):
    """A model of latent vectors alone: runs of a scene in, latent vectors out, no particle moved.

    Steps are the scene's, as the training frames are.

    Attributes:
        knows_forcing: whether `run` sees gravity and solids; else a run under a hand is not believed.
    """

    knows_forcing: ClassVar[bool] = True

    @abstractmethod
    def fit(self, manifold, lessons: Lessons, validation: Validation | None, seed: int) -> Any:
        """Learn from full-order runs.

        Args:
            manifold: trained fields.
            lessons: the runs; those of training, and with `nsf.models.drawn.Drawn` of drawn cases.
            validation: by which to choose; None of a model that does not derive from `Drawn`.
            seed: of all randomness.

        Returns:
            The first argument of `run`. With `Drawn` `nsf teach` writes it into a file: tensors, numbers and
            texts, in dicts and lists.
        """

    @abstractmethod
    def run(self, fitted: Any, inputs: Inputs) -> np.ndarray:
        """x̂ [B, N + 1, r] of runs."""

    @override
    def refuse(self, pipeline) -> None:
        c = pipeline.config
        if c.deploy.dt_multiplier != 1:
            raise ConfigError(
                f"model={self.name} gives frames of the scene's Δt, and deploy.dt_multiplier is "
                f"{c.deploy.dt_multiplier:g}; set it to 1, or model=projected"
            )
        if c.deploy.changes:
            raise ConfigError(
                f"model={self.name} knows the scene of training alone, and deploy.changes deploys another; "
                "set model=projected"
            )

        if c.data.every > 1 and not self.learns:
            raise ConfigError(
                f"model={self.name} learns from each step, and data.every={c.data.every} stores not all; "
                "set data.every=1"
            )

    @override
    def engine(self, pipeline, manifold):
        from nsf.models.lookup import LatentEngine

        return LatentEngine(self, pipeline.fitted(manifold))
