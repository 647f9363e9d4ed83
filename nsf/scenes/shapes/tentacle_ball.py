"""A squishy ball: a core with tentacles all round."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nsf.errors import ConfigError
from nsf.scalars import length, number
from nsf.scenes.shapes.geometry import Ball, Shape
from nsf.vectors import vector

# Each is held to each other, and each point to each.
_MOST = 2000


@dataclass(frozen=True)
class TentacleBall(Shape):
    """A sphere with straight tentacles of one size in evenly spread directions, their tips round.

    Attributes:
        centre: [m].
        radius: of the core [m].
        tentacles: how many.
        length: of a tentacle from the core's surface to its tip [m].
        tentacle_radius: [m].

    Raises:
        ConfigError: a value is not positive, a tentacle is shorter than its radius, or tentacles
            touch outside the core. The volume would not be the one given.

    Source: paper section 6.5, "squishy ball"; its measures are not in the paper. The directions are
    the Fibonacci lattice on the sphere (Gonzalez 2010, "Measurement of areas on a sphere using
    Fibonacci and latitude-longitude lattices").
    """

    centre: Sequence[float]
    radius: float
    tentacles: int
    length: float
    tentacle_radius: float

    def __post_init__(self):
        vector("tentacle ball centre", self.centre, "m")
        number("tentacles", self.tentacles, least=1, whole=True)
        if self.tentacles > _MOST:
            raise ConfigError(f"tentacles={self.tentacles} are more than {_MOST}; take fewer")
        for name in ("radius", "length", "tentacle_radius"):
            length(f"tentacle ball {name}", getattr(self, name))
        if self.length < self.tentacle_radius:
            raise ConfigError(
                f"tentacle ball length={self.length} m must be at least its "
                f"tentacle_radius={self.tentacle_radius} m"
            )
        room = self.radius * np.sin(0.5 * self._smallest_angle())
        if self.tentacle_radius > room:
            raise ConfigError(
                f"{self.tentacles} tentacles of tentacle_radius={self.tentacle_radius} m overlap outside the "
                f"core; take at most {room:.4g} m, fewer tentacles or a larger radius={self.radius} m"
            )

    def _directions(self) -> np.ndarray:
        """[tentacles, 3] unit vectors."""
        k = np.arange(self.tentacles)
        z = 1.0 - (2.0 * k + 1.0) / self.tentacles
        around = np.pi * (3.0 - 5.0**0.5) * k
        ring = np.sqrt(1.0 - z**2)
        return np.stack([ring * np.cos(around), ring * np.sin(around), z], 1)

    def _smallest_angle(self) -> float:
        """Between two tentacles [rad], at most π, so that a lone one has room for the core's radius."""
        d = self._directions()
        cosine = (d @ d.T)[~np.eye(self.tentacles, dtype=bool)].max(initial=-1.0)
        return float(np.arccos(cosine))

    def _reach(self) -> float:
        """From the centre to the middle of a tip's half ball [m]."""
        return self.radius + self.length - self.tentacle_radius

    @property
    def volume(self) -> float:
        """Volume [m³], exact: the core, and of each tentacle what lies outside it."""
        R, a = float(self.radius), float(self.tentacle_radius)
        in_core = 2.0 / 3.0 * np.pi * (R**3 - (R**2 - a**2) ** 1.5)
        tentacle = np.pi * a**2 * self._reach() + 2.0 / 3.0 * np.pi * a**3
        return Ball(self.centre, R).volume + self.tentacles * (tentacle - in_core)

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Corners [m]."""
        centre, tips = np.asarray(self.centre, float), self._reach() * self._directions()
        lower = np.minimum(tips.min(0) - self.tentacle_radius, -self.radius)
        upper = np.maximum(tips.max(0) + self.tentacle_radius, self.radius)
        return centre + lower, centre + upper

    def contains(self, x: np.ndarray) -> np.ndarray:
        """Whether each point lies inside."""
        d = x - np.asarray(self.centre, float)
        squared = (d**2).sum(1)
        # Tentacles do not touch outside the core, so only the nearest can hold a point there.
        along = (d @ self._directions().T).max(1)
        beside = squared - along**2
        past = np.maximum(along - self._reach(), 0.0)
        in_tentacle = (along > 0.0) & (beside + past**2 <= self.tentacle_radius**2)
        return (squared <= self.radius**2) | in_tentacle
