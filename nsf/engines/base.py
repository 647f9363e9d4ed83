"""The interface of an engine: one way to compute the steps of reduced runs."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import ClassVar

from nsf.dynamics.batch import Batch
from nsf.dynamics.setup import Setup
from nsf.dynamics.span import Span
from nsf.mpm import Gravity


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

    def doubt(self, setup: Setup, gravity: Gravity) -> tuple[float, str]:
        """How far a run's input lies outside of what the engine learned from, in units of its range.

        Args:
            setup: of the run.
            gravity: in its course, which a hand may still change.

        Returns:
            At most 1 where it is inside, and 0 where nothing is learned; and a text of what lies outside.
        """
        return 0.0, ""
