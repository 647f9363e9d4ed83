"""The cheapest of the models that are near enough at validation cases."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from typing_extensions import override

from nsf.errors import ConfigError
from nsf.models.base import Model
from nsf.scalars import number


@dataclass(frozen=True)
class Measured:
    """A model at the validation cases.

    Attributes:
        name: of the model.
        error: mean displacement error, a fraction; ∞ where a run diverged, NaN where it was not run.
        seconds: mean wall time of a run's steps [s].
        refused: why it was not run; empty where it was.
    """

    name: str
    error: float = math.nan
    seconds: float = math.nan
    refused: str = ""

    @property
    def plain(self) -> dict:
        """For the record; what is no number is None."""
        numbers = {"error": self.error, "seconds": self.seconds}
        finite = {name: value if math.isfinite(value) else None for name, value in numbers.items()}
        return {"model": self.name, **finite, "refused": self.refused}


@dataclass(frozen=True)
class Auto(Model):
    """Takes the cheapest model whose error at validation cases is within `slack` of the best.

    Attributes:
        slack: times the smallest error that the error of the chosen model may be, at least 1.
        candidates: names of models; None for all of the group but `auto` and `full`.
        of: the models by name, as their files in `conf/model` have them.
    """

    slack: float = 1.25
    candidates: Sequence[str] | None = None
    of: Mapping[str, Model] | None = None

    def __post_init__(self):
        if number("slack", self.slack) < 1:
            raise ConfigError(f"slack={self.slack} must be at least 1: the best model is within 1 of itself")

    @override
    def engine(self, pipeline, manifold):
        return pipeline.model.engine(pipeline, manifold)

    def choose(self, measured: Sequence[Measured]) -> str:
        """The name of the model to take, of those that were measured.

        Raises:
            ConfigError: none could run.
        """
        ran = [
            candidate for candidate in measured if not candidate.refused and not math.isnan(candidate.error)
        ]
        if not ran:
            raise ConfigError(
                "model=auto has no candidate that can run: "
                + "; ".join(f"{candidate.name}: {candidate.refused}" for candidate in measured)
            )
        best = min(candidate.error for candidate in ran)
        near = [candidate for candidate in ran if candidate.error <= self.slack * best]
        return min(near, key=lambda candidate: candidate.seconds).name
