"""Which parameter values train a model, and which it has never seen."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

from nsf.errors import ConfigError

# Relative; values equal to this are one value. Wider than a float32 round trip (6e-8).
TOLERANCE = 1e-6


@dataclass(frozen=True)
class Split:
    """Parameter values by part; frames of one value never part.

    A value is a number, or for several parameters a tuple in the order of
    their sorted names; a mapping by name does as well. Parts are kept as tuples of float.

    Raises:
        ConfigError: a part shares or repeats a value, a value is not finite,
            values differ in the number of parameters, or `train` is empty.
    """

    train: Sequence[Any]
    validation: Sequence[Any] = ()
    test: Sequence[Any] = ()

    def __post_init__(self) -> None:
        entries = [(part, _value(value)) for part in _PARTS for value in getattr(self, part)]
        for part in _PARTS:
            values = tuple(
                value[0] if len(value) == 1 else value for owner, value in entries if owner == part
            )
            object.__setattr__(self, part, values)
        if not self.train:
            raise ConfigError("train=() has no parameter value; give at least one")
        for part, value in entries:
            if not value or not all(map(math.isfinite, value)):
                raise ConfigError(f"{part} holds {_text(value)}; give finite numbers")
            if len(value) != len(entries[0][1]):
                first = _text(entries[0][1])
                raise ConfigError(
                    f"{part} holds {_text(value)} beside {first}; give as many parameters to each"
                )
        for (part, value), (other, same) in combinations(entries, 2):
            if _same(value, same):
                where = f"twice in {part}" if part == other else f"in both {part} and {other}"
                raise ConfigError(f"{_text(value)} is {where}; keep it in one place")

    def of(self, value: Any) -> str:
        """The part a parameter value (number, sequence or mapping) is in: "train", "validation" or "test".

        Raises:
            ConfigError: it belongs to none.
        """
        wanted = _value(value)
        for part in _PARTS:
            if any(_same(wanted, _value(known)) for known in getattr(self, part)):
                return part
        known = ", ".join(f"{part}={getattr(self, part)}" for part in _PARTS)
        raise ConfigError(f"{_text(wanted)} is in no part of the split ({known}); add it to one")


_PARTS = ("train", "validation", "test")


def _value(value: Any) -> tuple[float, ...]:
    if isinstance(value, Mapping):
        value = [value[name] for name in sorted(value)]
    try:
        return tuple(float(item) for item in value) if isinstance(value, Iterable) else (float(value),)
    except (TypeError, ValueError) as error:
        raise ConfigError(f"parameter value {value!r} is no number; give numbers") from error


def _same(a: tuple[float, ...], b: tuple[float, ...]) -> bool:
    return len(a) == len(b) and all(
        math.isclose(x, y, rel_tol=TOLERANCE, abs_tol=1e-12) for x, y in zip(a, b, strict=True)
    )


def _text(value: tuple[float, ...]) -> str:
    return str(value[0] if len(value) == 1 else value)
