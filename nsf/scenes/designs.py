"""Designs of experiments: which cases of a scene are trained on, and which are held out."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from nsf.data.case import PROGRAM, Case
from nsf.data.split import Split
from nsf.errors import ConfigError
from nsf.scalars import is_finite, number
from nsf.scenes.parameters import Parameter
from nsf.vectors import is_list

#: Programs are numbered apart: those of another part, and of another seed, have other numbers.
_PARTS, _SEEDS = 1000, 10_000
#: Significant digits of a drawn value, which its text shows in full.
_DIGITS = 6


class Design(ABC):
    """Draws the cases of a scene."""

    @abstractmethod
    def split(self, parameters: Mapping[str, Parameter]) -> Split:
        """The cases, by their use.

        Args:
            parameters: of the scene, by name; `program` stands for the number of a run's forcing program.

        Raises:
            ConfigError: a case is refused, or a parameter lacks a range; names the remedy.
        """


@dataclass(frozen=True)
class Values(Design):
    """Cases that are listed: numbers for one parameter.

    For several parameters each case is a list of numbers in the order of the parameters, or a mapping from
    name to number. Where programs force the runs a case may name the number of its own, last or as `program`;
    else it gets one.

    Attributes:
        train, validation, test: the cases.
    """

    train: Sequence
    test: Sequence
    validation: Sequence = ()

    def __post_init__(self):
        for part in ("train", "validation", "test"):
            if not is_list(cases := getattr(self, part)):
                raise ConfigError(f"scene.design.{part}={cases} must be a list, as [{cases}]")
        if not self.train:
            raise ConfigError("scene.design.train=[] must name at least one case")

    def split(self, parameters: Mapping[str, Parameter]) -> Split:
        """See `Design.split`; a value outside a declared range is refused as well."""
        parts = {}
        for number_of_part, part in enumerate(("train", "validation", "test")):
            where, cases = f"scene.design.{part}", getattr(self, part)
            first = _first_program(0, number_of_part, len(cases))
            numbered = (_programmed(parameters, given, first + i) for i, given in enumerate(cases))
            parts[part] = [case_of(parameters, given, where) for given in numbered]
            for case in parts[part]:
                _check_inside(case, parameters, where)
        return _split(**parts)


@dataclass(frozen=True)
class _Drawn(Design):
    """Cases drawn from the ranges of the parameters; each part by a generator of its own.

    So a part stays as it is when another becomes larger.
    """

    train: int
    test: int
    validation: int = 0
    seed: int = 0
    test_seed: int | None = None

    def __post_init__(self):
        for part, least in (("train", 1), ("test", 1), ("validation", 0), ("seed", 0), ("test_seed", 0)):
            if part != "test_seed" or self.test_seed is not None:
                number(f"scene.design.{part}", getattr(self, part), least=least, whole=True)

    def split(self, parameters: Mapping[str, Parameter]) -> Split:
        """See `Design.split`."""
        other = self.seed if self.test_seed is None else self.test_seed
        parts = (self.train, self.seed), (self.validation, self.seed), (self.test, other)
        drawn, dimensions = [], len(parameters) - (PROGRAM in parameters)
        for part, (count, seed) in enumerate(parts):
            points = self._points(count, dimensions, np.random.default_rng([seed, part]))
            first = _first_program(seed, part, count)
            drawn.append(_cases(parameters, points, type(self).__name__, first))
        return _split(*drawn)

    @abstractmethod
    def _points(self, count: int, dimensions: int, generator: np.random.Generator) -> np.ndarray:
        """[count, dimensions] points of the unit cube."""


@dataclass(frozen=True)
class Sobol(_Drawn):
    """Scrambled Sobol points, a scramble for each part; the first of more points are those of fewer.

    Attributes:
        train, validation, test: numbers of cases; powers of two fill the ranges most evenly.
        seed: of the scrambles.
        test_seed: of the test cases; None: seed.

    Source: Sobol 1967; Owen 1998 (scrambling); scipy.stats.qmc.
    """

    def _points(self, count: int, dimensions: int, generator: np.random.Generator) -> np.ndarray:
        from scipy.stats import qmc

        # Whole powers of two: others are drawn with a warning.
        power = max(0, count - 1).bit_length()
        return qmc.Sobol(dimensions, seed=generator).random_base2(power)[:count]


@dataclass(frozen=True)
class LatinHypercube(_Drawn):
    """Latin hypercubes, one for each part: each parameter's range is cut into as many pieces as cases.

    Attributes:
        train, validation, test: numbers of cases.
        seed: of the draws.
        test_seed: of the test cases; None: seed.

    Source: McKay, Beckman, Conover 1979; scipy.stats.qmc.
    """

    def _points(self, count: int, dimensions: int, generator: np.random.Generator) -> np.ndarray:
        from scipy.stats import qmc

        return qmc.LatinHypercube(dimensions, seed=generator).random(count)


@dataclass(frozen=True)
class Grid(Design):
    """Training cases on a grid that reaches the ends of each range; held-out ones are Sobol points.

    Attributes:
        train: number of values along each parameter.
        validation, test: numbers of cases.
        seed: of the held-out cases.
        test_seed: of the test cases; None: seed.
    """

    train: Sequence[int]
    test: int
    validation: int = 0
    seed: int = 0
    test_seed: int | None = None

    def __post_init__(self):
        for count in self.train:
            number("scene.design.train", count, least=1, whole=True)
        self._held_out()  # is checked

    def split(self, parameters: Mapping[str, Parameter]) -> Split:
        """See `Design.split`."""
        own = [name for name in parameters if name != PROGRAM]
        if len(self.train) != len(own):
            raise ConfigError(
                f"scene.design.train={list(self.train)} must be {len(own)} numbers of values, "
                f"one for each of {', '.join(own)}"
            )
        held_out = self._held_out().split(parameters)
        ends = [np.linspace(0.0, 1.0, n) if n > 1 else np.array([0.5]) for n in self.train]
        points = np.stack(np.meshgrid(*ends, indexing="ij"), -1).reshape(-1, len(ends))
        train = _cases(parameters, points, "Grid", _first_program(self.seed, 0, len(points)))
        return _split(train, held_out.validation, held_out.test)

    def _held_out(self) -> Sobol:
        return Sobol(1, self.test, self.validation, self.seed, self.test_seed)


def case_of(parameters: Mapping[str, Parameter], given, where: str) -> Case:
    """A case from a number, a list of numbers in the parameters' order, or a mapping from name to number.

    Args:
        parameters: of the scene, by name.
        given: the number, list or mapping.
        where: where it comes from, for messages.

    Raises:
        ConfigError: it has not one finite number for each parameter.
    """
    if isinstance(given, Mapping):
        if unknown := [name for name in given if name not in parameters]:
            raise ConfigError(f"{where} has no parameter {unknown[0]!r}; there are {', '.join(parameters)}")
        values = [given.get(name) for name in parameters]
    else:
        values = list(given) if is_list(given) else [given]
    if len(values) != len(parameters) or not all(map(is_finite, values)):
        wanted = "be a finite number" if len(parameters) == 1 else f"have {len(parameters)} finite numbers"
        raise ConfigError(f"{where}: {given} must {wanted}, as {', '.join(parameters)}")
    return Case(tuple(parameters), tuple(values), tuple(p.unit for p in parameters.values()))


def _programmed(parameters: Mapping[str, Parameter], given, program: int):
    """A case as it is given, with the number of a program where it asks for one and names none."""
    if PROGRAM not in parameters:
        return given
    if isinstance(given, Mapping):
        return {PROGRAM: program} | dict(given)
    values = list(given) if is_list(given) else [given]
    return [*values, program] if len(values) == len(parameters) - 1 else values


def evenly(count: int, dimensions: int) -> np.ndarray:
    """[count, dimensions] points that fill the unit cube evenly, however many of them are taken.

    Source: Roberts 2018, the additive recurrence of the root of x^(d+1) = x + 1; in one dimension the golden
    ratio.
    """
    root = 2.0
    for _ in range(60):
        root = (1.0 + root) ** (1.0 / (dimensions + 1))
    return np.outer(np.arange(1, count + 1), root ** -np.arange(1.0, dimensions + 1)) % 1.0


def _check_inside(case: Case, parameters: Mapping[str, Parameter], where: str) -> None:
    """Raises ConfigError where a value is outside of the declared range."""
    for name, parameter in parameters.items():
        if parameter.range and not parameter.range[0] <= case[name] <= parameter.range[1]:
            raise ConfigError(
                f"{where}: {name}={case[name]:g} is outside of scene.parameters.{name}.range="
                f"{list(parameter.range)}; widen the range, or leave it out"
            )


def _first_program(seed: int, part: int, count: int) -> int:
    """Number of the first program of a part of a design."""
    if count > _PARTS:
        raise ConfigError(f"scene.design has {count} cases in a part; programs are numbered up to {_PARTS}")
    return _SEEDS * seed + _PARTS * part


def _cases(parameters: Mapping[str, Parameter], points: np.ndarray, design: str, first: int) -> list[Case]:
    """Cases of points [n, d] of the unit cube, in the parameters' ranges; programs count from `first`."""
    columns = []
    own = [(name, parameter) for name, parameter in parameters.items() if name != PROGRAM]
    for (name, parameter), u in zip(own, points.T, strict=True):
        if parameter.range is None:
            raise ConfigError(
                f"scene.parameters.{name} has no range, which {design} draws from; give it range: [low, high]"
            )
        low, high = np.log(parameter.range) if parameter.log else parameter.range
        values = low + u * (high - low)
        values = np.exp(values) if parameter.log else values
        rounded = [float(f"{value:.{_DIGITS}g}") for value in values]
        columns.append(np.clip(rounded, *parameter.range).tolist())
    if PROGRAM in parameters:
        columns.append(list(range(first, first + len(points))))
    units = tuple(parameter.unit for parameter in parameters.values())
    return [Case(tuple(parameters), numbers, units) for numbers in zip(*columns, strict=True)]


def _split(train: Sequence[Case], validation: Sequence[Case], test: Sequence[Case]) -> Split:
    try:
        return Split(train=train, validation=validation, test=test)
    except ConfigError as error:
        raise ConfigError(f"scene.design: {error}") from error


#: Forcing programs of `random_cases` have numbers from here on, for each seed.
_PROGRAMS = 1_000_000


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
    cases = [Case(taken[0].names, point, taken[0].units) for point in rows]
    return [case for case in cases if case not in taken]
