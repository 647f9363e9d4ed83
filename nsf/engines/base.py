"""What an engine is: one way to compute the steps of reduced runs."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import ClassVar

from nsf.dynamics.batch import Batch
from nsf.dynamics.setup import Setup
from nsf.dynamics.span import Span


class Engine(ABC):
    """Computes the steps of reduced runs; equal to the reference but for round-off.

    Attributes:
        name: as `engine=` takes it.
    """

    name: ClassVar[str]

    @abstractmethod
    def refusal(self, setups: Sequence[Setup]) -> str:
        """Why it cannot step runs of these setups together; empty where it can."""

    @abstractmethod
    def spans(self, batch: Batch) -> Sequence[Span]:
        """What takes the steps of each span of time, of runs that are not refused."""
