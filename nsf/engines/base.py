"""The interface of an engine: one way to compute the steps of reduced runs."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import ClassVar

from nsf.dynamics.batch import Batch
from nsf.dynamics.setup import Setup
from nsf.dynamics.span import Span


class Engine(ABC):
    """Computes the steps of reduced runs; equal to the reference but for round-off, unless it is learned.

    Attributes:
        name: for the record.
        moves_particles: whether a step moves sample particles, and not the latent vector alone.
    """

    name: ClassVar[str]
    moves_particles: ClassVar[bool] = True

    @abstractmethod
    def refusal(self, setups: Sequence[Setup]) -> str:
        """Why it cannot step runs of these setups together; empty where it can."""

    @abstractmethod
    def spans(self, batch: Batch) -> Sequence[Span]:
        """The spans of time that take the steps of runs that are not refused."""
