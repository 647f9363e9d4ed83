"""Shapes and how particles are placed in them."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nsf.errors import ConfigError


@dataclass(frozen=True)
class Shape(ABC):
    """A solid region of the domain."""

    @property
    @abstractmethod
    def volume(self) -> float:
        """Volume [m³]."""

    @property
    @abstractmethod
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper corner [3] [m] of the bounding box."""

    @abstractmethod
    def contains(self, x: np.ndarray) -> np.ndarray:
        """[n] whether each of the points x [n, 3] [m] lies inside."""

    def sample(self, count: int, start: int = 0) -> np.ndarray:
        """Evenly spread points of the shape.

        Points `start … start + count − 1` of one endless sequence, so more points of the
        same shape (super-resolution) go on where fewer ended. Deterministic.

        Args:
            count: number of points.
            start: points of the sequence to pass over.

        Returns:
            [count, 3] [m].

        Raises:
            ConfigError: count is not positive.

        Source: an additive recurrence (Roberts 2018, "The unreasonable effectiveness of
        quasirandom sequences") over the cube of the longest edge, kept where inside. Stretched
        to a thin box it would leave cells empty. Its addends 2^(k/4), in place of Roberts'
        golden ratio, keep the scatter of a cell's count below 0.65 of that of random points.
        """
        if count < 1:
            raise ConfigError(f"particles={count} must be at least 1")
        lower, upper = self.bounds
        edge = float((upper - lower).max())
        found, drawn, kept = [], 0, 0
        while kept < start + count:
            indices = np.arange(drawn + 1, drawn + 1 + 65536, dtype=np.float64)
            points = lower + edge * np.modf(0.5 + indices[:, None] * _ADDENDS)[0]
            points = points[self.contains(points)]
            found.append(points)
            drawn, kept = drawn + 65536, kept + len(points)
        return np.concatenate(found)[start : start + count]


# With 1 a basis of a quartic field, hence badly approximable by fractions together.
_ADDENDS = 2.0 ** (np.arange(1.0, 4.0) / 4.0)


@dataclass(frozen=True)
class Box(Shape):
    """An axis-aligned box.

    Attributes:
        lower, upper: opposite corners [m].

    Raises:
        ConfigError: a corner is not below the other.
    """

    lower: Sequence[float]
    upper: Sequence[float]

    def __post_init__(self):
        if len(self.lower) != 3 or len(self.upper) != 3 or not np.all(np.less(self.lower, self.upper)):
            raise ConfigError(f"box lower={self.lower} must lie below upper={self.upper} in each of 3 axes")

    @property
    def volume(self) -> float:
        """Volume [m³]."""
        return float(np.prod(np.subtract(self.upper, self.lower)))

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Corners [m]."""
        return np.asarray(self.lower, float), np.asarray(self.upper, float)

    def contains(self, x: np.ndarray) -> np.ndarray:
        """Whether each point lies inside."""
        lower, upper = self.bounds
        return ((x >= lower) & (x <= upper)).all(1)


@dataclass(frozen=True)
class Cylinder(Shape):
    """An upright circular cylinder.

    Attributes:
        base: centre of the bottom disc [m].
        radius, height: [m].

    Raises:
        ConfigError: radius or height is not positive.
    """

    base: Sequence[float]
    radius: float
    height: float

    def __post_init__(self):
        if len(self.base) != 3 or not (self.radius > 0 and self.height > 0):
            raise ConfigError(
                f"cylinder base={self.base} radius={self.radius} height={self.height}: give positive lengths"
            )

    @property
    def volume(self) -> float:
        """Volume [m³]."""
        return float(np.pi * self.radius**2 * self.height)

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Corners [m]."""
        base = np.asarray(self.base, float)
        reach = np.array([self.radius, self.radius, 0.0])
        return base - reach, base + reach + [0.0, 0.0, self.height]

    def contains(self, x: np.ndarray) -> np.ndarray:
        """Whether each point lies inside."""
        d = x - np.asarray(self.base, float)
        return (d[:, 0] ** 2 + d[:, 1] ** 2 <= self.radius**2) & (d[:, 2] >= 0) & (d[:, 2] <= self.height)
