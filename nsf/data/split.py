"""Which cases train a model, and which it has never seen."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from nsf.data.case import Case
from nsf.errors import ConfigError


@dataclass(frozen=True)
class Split:
    """Cases by part; frames of one case never part.

    Raises:
        ConfigError: a part shares or repeats a case, cases differ in their parameters, or `train` is empty.
    """

    train: Sequence[Case]
    validation: Sequence[Case] = ()
    test: Sequence[Case] = ()

    def __post_init__(self) -> None:
        for part in _PARTS:
            object.__setattr__(self, part, tuple(getattr(self, part)))
        if not self.train:
            raise ConfigError("train=[] must name at least one case")
        entries = [(part, case) for part in _PARTS for case in getattr(self, part)]
        for part, case in entries:
            if case.names != self.train[0].names:
                raise ConfigError(
                    f"{part} holds {case.named} beside {self.train[0].named}; give each the same parameters"
                )
        for (part, case), (other, same) in combinations(entries, 2):
            if case == same:
                where = f"twice in {part}" if part == other else f"in both {part} and {other}"
                raise ConfigError(f"{case} is {where}; a case belongs to one split, once")

    @property
    def names(self) -> tuple[str, ...]:
        """Of the parameters."""
        return self.train[0].names

    @property
    def cases(self) -> tuple[Case, ...]:
        """The cases of all parts."""
        return (*self.train, *self.validation, *self.test)

    @property
    def box(self) -> np.ndarray:
        """[n, 2] smallest and largest training value of each parameter; programs have none."""
        numbers = np.array([list(case.parameters.values()) for case in self.train])
        return np.stack([numbers.min(0), numbers.max(0)], axis=1)


_PARTS = ("train", "validation", "test")
