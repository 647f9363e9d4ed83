"""A run of a family: the value that each problem parameter has in it."""

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

from nsf.errors import ConfigError

#: Name, beside those of the parameters, of the number of a run's forcing program.
PROGRAM = "program"
_NEXT = re.compile(r", (?=[A-Za-z]\w*=)")  # between two parameters of `Case.named`
_ONE = re.compile(r"([A-Za-z]\w*)=([-+]?[\d.]+(?:e[-+]?\d+)?)(°| \S.*)?", re.ASCII)


@dataclass(frozen=True, order=True)
class Case(Mapping[str, float]):
    """The problem parameters of one run, and which program its forcing follows; a mapping from name to value.

    Attributes:
        names: of the parameters, in the scene's order; `program` is the last where the forcing has programs.
        numbers: their values.
        units: theirs, for people; they tell no cases apart.

    Raises:
        ConfigError: there are not as many values as names, or one is not finite.
    """

    names: tuple[str, ...]
    numbers: tuple[float, ...]
    units: tuple[str, ...] = field(default=(), compare=False)

    def __post_init__(self):
        for name in ("names", "numbers", "units"):
            object.__setattr__(self, name, tuple(getattr(self, name)))
        if not self.names or len(self.names) != len(self.numbers):
            raise ConfigError(f"{self.numbers} must be one number for each of {', '.join(self.names)}")
        try:
            object.__setattr__(self, "numbers", tuple(map(float, self.numbers)))
        except (TypeError, ValueError) as error:
            raise ConfigError(f"{self.numbers} must be numbers: {error}") from error
        if not all(map(math.isfinite, self.numbers)):
            raise ConfigError(f"{self.named} must be finite")

    @classmethod
    def of(cls, values: Mapping[str, float], units: Sequence[str] = ()) -> "Case":
        """The case of a mapping from name to value."""
        return cls(tuple(values), tuple(values.values()), units)

    @classmethod
    def read(cls, named: str) -> "Case":
        """The case that `named` tells of, whose values have six digits there.

        Raises:
            ConfigError: it tells of none.
        """
        matches = [_ONE.fullmatch(part) for part in _NEXT.split(named)]
        if not all(matches):
            raise ConfigError(f"{named!r} names no case, as E=1500 Pa, friction=0.3 does")
        names, values, units = zip(*(one.groups(default="") for one in matches if one), strict=True)
        return cls(names, values, [unit.strip() for unit in units])

    def __getitem__(self, name: str) -> float:
        try:
            return self.numbers[self.names.index(name)]
        except ValueError:
            raise KeyError(name) from None

    def __iter__(self) -> Iterator[str]:
        return iter(self.names)

    def __len__(self) -> int:
        return len(self.names)

    def __str__(self) -> str:
        return self.text

    @property
    def parameters(self) -> dict[str, float]:
        """The problem parameters alone."""
        return {name: value for name, value in self.items() if name != PROGRAM}

    @property
    def text(self) -> str:
        """For people: `26°` of one parameter, `E=1500 Pa, friction=0.3` of several."""
        return self.named if len(self) > 1 else self._valued[0]

    @property
    def named(self) -> str:
        """For people, with the names: `friction_angle=26°`."""
        return ", ".join(f"{name}={value}" for name, value in zip(self.names, self._valued, strict=True))

    @property
    def label(self) -> str:
        """For names of files: `friction_angle_26`, `E_1500_friction_0.3`."""
        return re.sub(r"[^\w.+-]", "_", "_".join(f"{name}_{self[name]:g}" for name in self))

    @property
    def column(self) -> float | str:
        """For tables: the number of one parameter, the text of several."""
        return self.text if len(self) > 1 else self.numbers[0]

    @property
    def _valued(self) -> list[str]:
        units = self.units or ("",) * len(self)
        return [with_unit(f"{value:g}", unit) for value, unit in zip(self.numbers, units, strict=True)]


def with_unit(value: str, unit: str) -> str:
    """A value and its unit; `""` and `-` are no unit."""
    return f"{value}{'' if unit == '°' else ' '}{unit}" if unit not in ("", "-") else value
