"""Shapes and how particles are placed in them."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from nsf.errors import ConfigError
from nsf.scalars import length
from nsf.vectors import vector


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

    @property
    def files(self) -> dict[str, str]:
        """Path and sha256 of every file that the shape is read from."""
        return {}

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
            ConfigError: count is not positive, or the shape fills so little of its cube that finding the
                points would take minutes.

        Source: an additive recurrence (Roberts 2018, "The unreasonable effectiveness of
        quasirandom sequences") over the cube of the longest edge, kept where inside. Stretched
        to a thin box it would leave cells empty. Its addends 2^(k/4), in place of Roberts'
        golden ratio, keep the scatter of a cell's count below 0.65 of that of random points.
        """
        if count < 1:
            raise ConfigError(f"particles={count} must be at least 1")
        lower, upper = self.bounds
        edge = float((upper - lower).max())
        share = self.volume / edge / edge / edge
        # Twice as many as the volume asks for, should `contains` hold less than that.
        most = 2 * (start + count) / share + _DRAWN if share * _MOST_DRAWN > start + count else 0
        found, drawn, kept = [], 0, 0
        while kept < start + count:
            if drawn >= most:
                raise ConfigError(
                    f"particles={start + count} cannot be placed in a shape that fills {share:.2g} of the "
                    f"cube about it (bounds {lower} to {upper} m); make it thicker or take fewer particles"
                )
            points = self._drawn(drawn, edge)
            found.append(points[self.contains(points)])
            drawn, kept = drawn + _DRAWN, kept + len(found[-1])
        return np.concatenate(found)[start : start + count]

    def _drawn(self, start: int, edge: float) -> np.ndarray:
        """The points [n, 3] of the next stretch of the cube's sequence that lie within the bounds."""
        indices = np.arange(start + 1, start + 1 + _DRAWN, dtype=np.float64)
        lower, upper = self.bounds
        # By the thinnest axis first: of a thin shape few points are left for the others.
        for axis in np.argsort(upper - lower):
            x = lower[axis] + edge * np.modf(0.5 + indices * _ADDENDS[axis])[0]
            indices = indices[(x >= lower[axis]) & (x <= upper[axis])]
        return lower + edge * np.modf(0.5 + indices[:, None] * _ADDENDS)[0]


# Points of the cube's sequence that are looked at together, and in all: some ten seconds.
_DRAWN, _MOST_DRAWN = 2**16, 2**29
# With 1 a basis of a quartic field, hence badly approximable by fractions together.
_ADDENDS = 2.0 ** (np.arange(1.0, 4.0) / 4.0)

AXES = {"x": 0, "y": 1, "z": 2}


@dataclass(frozen=True)
class Box(Shape):
    """An axis-aligned box.

    Attributes:
        lower, upper: opposite corners [m].

    Raises:
        ConfigError: a corner is not 3 finite numbers, or not below the other.
    """

    lower: Sequence[float]
    upper: Sequence[float]

    def __post_init__(self):
        lower, upper = vector("box lower", self.lower, "m"), vector("box upper", self.upper, "m")
        if not np.all(np.less(lower, upper)):
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
class Lattice(Box):
    """A box whose first particles lie on a lattice, as textbook problems have them; others are spread in it.

    Evenly spread particles have noise of stress, and make a part of few cells too soft in bending.

    Attributes:
        lower, upper: opposite corners [m].
        spacing: of the lattice, which begins half of it inside the box [m].

    Raises:
        ConfigError: as for `Box`, or the spacing is not positive and finite.
    """

    spacing: float = field(kw_only=True)

    def __post_init__(self):
        super().__post_init__()
        length("lattice spacing", self.spacing)

    def sample(self, count: int, start: int = 0) -> np.ndarray:
        """The lattice, then evenly spread points; of fewer points than the lattice has all are spread."""
        edges = np.subtract(self.upper, self.lower)
        axes = [self.spacing * (np.arange(round(edge / self.spacing)) + 0.5) for edge in edges]
        lattice = self.lower + np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
        more = start + count - len(lattice)
        if more < 0 or start >= len(lattice):
            return super().sample(count, start if more < 0 else start - len(lattice))
        return np.concatenate([lattice, super().sample(more) if more else lattice[:0]])[start:]


@dataclass(frozen=True)
class Cylinder(Shape):
    """An upright circular cylinder.

    Attributes:
        base: centre of the bottom disc [m].
        radius, height: [m].

    Raises:
        ConfigError: the base is not 3 finite numbers, or radius or height not positive and finite.
    """

    base: Sequence[float]
    radius: float
    height: float

    def __post_init__(self):
        vector("cylinder base", self.base, "m")
        length("cylinder radius", self.radius)
        length("cylinder height", self.height)

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


@dataclass(frozen=True)
class QuarterCylinder(Cylinder):
    """The quarter of an upright circular cylinder that two planes of symmetry, along x and y, leave of it.

    Attributes:
        base: foot of the axis, the corner of lowest x, y and z [m].
        radius, height: [m].
    """

    @property
    def volume(self) -> float:
        """Volume [m³]."""
        return super().volume / 4.0

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper corner [m]."""
        base = np.asarray(self.base, float)
        return base, base + np.array([self.radius, self.radius, self.height])

    def contains(self, x: np.ndarray) -> np.ndarray:
        """Whether each point lies inside."""
        return super().contains(x) & (x[:, :2] >= self.bounds[0][:2]).all(1)


@dataclass(frozen=True)
class Ball(Shape):
    """A solid sphere.

    Attributes:
        centre: [m].
        radius: [m].

    Raises:
        ConfigError: the centre is not 3 numbers, or the radius is not positive.
    """

    centre: Sequence[float]
    radius: float

    def __post_init__(self):
        vector("ball centre", self.centre, "m")
        length("ball radius", self.radius)

    @property
    def volume(self) -> float:
        """Volume [m³]."""
        return 4.0 / 3.0 * np.pi * self.radius**3

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Corners [m]."""
        centre = np.asarray(self.centre, float)
        return centre - self.radius, centre + self.radius

    def contains(self, x: np.ndarray) -> np.ndarray:
        """Whether each point lies inside."""
        return ((x - np.asarray(self.centre, float)) ** 2).sum(1) <= self.radius**2


@dataclass(frozen=True)
class Frame(Shape):
    """A rectangular frame: a box with a through-hole, the bars equally thick all round.

    Attributes:
        lower, upper: opposite outer corners [m].
        thickness: of the bars, across the hole [m].
        axis: `x`, `y` or `z`, along which the hole passes through.

    Raises:
        ConfigError: the corners are those of no box, the axis is unknown, or the bars close the hole.
    """

    lower: Sequence[float]
    upper: Sequence[float]
    thickness: float
    axis: str = "y"

    def __post_init__(self):
        outer = Box(self.lower, self.upper)
        length("frame thickness", self.thickness)
        if self.axis not in AXES:
            raise ConfigError(f"frame axis={self.axis!r} is unknown; choose x, y or z")
        across = np.delete(outer.bounds[1] - outer.bounds[0], AXES[self.axis])
        if not 2.0 * self.thickness < across.min():
            raise ConfigError(
                f"frame thickness={self.thickness} m closes the hole; "
                f"give less than half of {across.min():g} m, its shorter side"
            )

    def _hole(self) -> tuple[np.ndarray, np.ndarray]:
        """Corners of the hole, as long as the box [m]."""
        inset = np.full(3, float(self.thickness))
        inset[AXES[self.axis]] = 0.0
        lower, upper = self.bounds
        return lower + inset, upper - inset

    @property
    def volume(self) -> float:
        """Volume [m³]."""
        return Box(self.lower, self.upper).volume - Box(*self._hole()).volume

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Outer corners [m]."""
        return Box(self.lower, self.upper).bounds

    def contains(self, x: np.ndarray) -> np.ndarray:
        """Whether each point lies inside."""
        return Box(self.lower, self.upper).contains(x) & ~Box(*self._hole()).contains(x)
