"""What is taught: how, along which values, what the teacher answered, and by what a round is judged."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from nsf.data import PROGRAM, Case
from nsf.engines.operators.teacher import Teacher
from nsf.errors import ConfigError
from nsf.scenes.designs import evenly

#: Forcing programs that are drawn for teaching have numbers from here on, for each seed.
_PROGRAMS = 1_000_000


@dataclass(frozen=True)
class Teaching:
    """How operators are taught.

    Attributes:
        width: of both hidden layers.
        rounds: along the operators' own runs, after the first.
        steps: of the teacher, about, in all.
        descent: steps of Adam in each round.
        rate: learning rate of the first round; half of it later.
        unroll: steps of a window.
        noise: on the start of a window [deviations of x̂].
        tube: deviation of states about training runs [deviations of x̂].
        gravity: by how much the gravity of labels in the tube is varied [-], of its magnitude.

    Raises:
        ConfigError: a value outside its range.
    """

    width: int = 96
    rounds: int = 3
    steps: int = 8000
    descent: int = 3000
    rate: float = 3e-3
    unroll: int = 8
    noise: float = 0.01
    tube: float = 0.05
    gravity: float = 0.1

    def __post_init__(self):
        for name, least in (("width", 1), ("rounds", 0), ("steps", 1), ("descent", 1), ("unroll", 1)):
            if getattr(self, name) < least:
                raise ConfigError(f"{name}={getattr(self, name)} must be at least {least}")
        for name in ("rate", "noise", "tube", "gravity"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) >= 0):
                raise ConfigError(f"{name}={getattr(self, name)} must be finite and at least 0")


@dataclass(frozen=True)
class Yardstick:
    """Runs that decide which round is kept, none of them at a held-out value.

    Attributes:
        teacher: at their values.
        positions: xhat [N + 1, r] → [N + 1, s, 3] [m] positions of particles that are looked at.
        truth: [N + 1, R, s, 3] [m] where these are.
    """

    teacher: Teacher
    positions: Callable[[Tensor], Tensor]
    truth: Tensor

    def error(self, runs: Tensor) -> float:
        """Mean displacement error of runs [N + 1, R, r], a fraction; ∞ where one is not finite."""
        if not bool(torch.isfinite(runs).all()):
            return math.inf
        errors = []
        for run, truth in zip(runs.unbind(1), self.truth.unbind(1), strict=True):
            moved = (truth - truth[0]).square().sum()
            errors.append(((self.positions(run) - truth).square().sum() / moved).sqrt())
        return float(torch.stack(errors).mean())


@dataclass
class Labels:
    """What the teacher answered.

    Attributes:
        xhat, change: [M, r] states; acceleration: [M, r] d' − d.
        parameters: [M, n]; gravity: [M, 3] [m/s²]; features: [M, f] of the colliders.
    """

    xhat: Tensor
    change: Tensor
    acceleration: Tensor
    parameters: Tensor
    gravity: Tensor
    features: Tensor

    @classmethod
    def joined(cls, parts: Sequence["Labels"]) -> "Labels":
        """All labels of some, those left out that are not finite."""
        rows = [torch.cat([getattr(part, name) for part in parts]) for name in cls.__dataclass_fields__]
        good = torch.stack([torch.isfinite(values).all(1) for values in rows]).all(0)
        return cls(*(values[good] for values in rows))


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
    return [case for case in found if not any(map(case.near, taken))]
