"""What is taught: how, and along which values; checked without torch."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nsf.data import PROGRAM, Case
from nsf.errors import ConfigError
from nsf.scenes.designs import evenly
from nsf.scenes.symmetry import Symmetry
from nsf.vectors import is_finite

_MOST_LAGS = 16
#: Forcing programs that are drawn for teaching have numbers from here on, for each seed.
_PROGRAMS = 1_000_000


@dataclass(frozen=True)
class Teaching:
    """How operators are taught.

    Attributes:
        width: of both hidden layers.
        rounds: along the operators' own runs, after the first; none where full-order runs are the teacher.
        steps: of the teacher, about, in all; more where each run would be asked at fewer than 40 moments.
        descent: steps in each round: Muon on matrices, Adam on biases.
        rate: learning rate of the first round, of both; half of it later.
        unroll: steps of a window.
        noise: on the start of a window [deviations of x̂].
        tube: deviation of states about training runs [deviations of x̂].
        gravity: by how much the gravity of labels in the tube is varied [-], of its magnitude.
        memory: times [s] of lags that the operators see; taught by runs alone.
        runs: projected runs in drawn cases, of which operators learn beside full-order ones.
        symmetry: of the scene; what runs teach, their mirror images teach as well.

    Raises:
        ConfigError: a value outside its range.
    """

    width: int = 96
    rounds: int = 3
    steps: int = 8000
    descent: int = 3000
    rate: float = 1e-2
    unroll: int = 8
    noise: float = 0.01
    tube: float = 0.02
    gravity: float = 0.1
    memory: Sequence[float] = ()
    runs: int = 0
    symmetry: Symmetry | None = None

    def __post_init__(self):
        object.__setattr__(self, "memory", times_of_lags(self.memory))
        for name, least in (
            ("runs", 0),
            ("width", 1),
            ("rounds", 0),
            ("steps", 1),
            ("descent", 1),
            ("unroll", 1),
        ):
            if getattr(self, name) < least:
                raise ConfigError(f"{name}={getattr(self, name)} must be at least {least}")
        for name in ("rate", "noise", "tube", "gravity"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) >= 0):
                raise ConfigError(f"{name}={getattr(self, name)} must be finite and at least 0")


def times_of_lags(memory: Sequence[float]) -> tuple[float, ...]:
    """The times [s] of a memory.

    Raises:
        ConfigError: one is not above 0, or there are too many.
    """
    for seconds in memory:
        if not (is_finite(seconds) and seconds > 0):
            raise ConfigError(f"memory={list(memory)} must be times in seconds, each above 0")
    if len(memory) > _MOST_LAGS:
        raise ConfigError(f"memory has {len(memory)} times; {_MOST_LAGS} at most")
    return tuple(memory)


def random_cases(box: np.ndarray, count: int, seed: int, taken: Sequence[Case]) -> list[Case]:
    """Cases in a box, spread evenly and shaken: points of a Hammersley set, each moved by up to 1/count.

    Args:
        box: [n, 2] smallest and largest value of each parameter.
        count: how many; one fewer for each that would be a case that is taken.
        seed: of the generator.
        taken: cases that are left out, at least one; they name the parameters.
    """
    even = np.column_stack([np.arange(count), count * evenly(count, len(box) - 1)])
    shaken = (even + np.random.default_rng(seed).random(even.shape)) / count % 1.0
    low, high = box.T
    rows = low + (high - low) * shaken
    if PROGRAM in taken[0].names:
        rows = np.column_stack([rows, _PROGRAMS * (1 + seed) + np.arange(count)])
    found = [Case(taken[0].names, point, taken[0].units) for point in rows]
    return [case for case in found if case not in taken]
