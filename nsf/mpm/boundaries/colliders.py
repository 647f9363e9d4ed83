"""Solids that the material meets: their shapes, contact and motion."""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from nsf.errors import ConfigError
from nsf.mpm.boundaries.contact import CUBOID, HALF_SPACE, KINDS, SPHERE
from nsf.mpm.boundaries.motion import Motion
from nsf.vectors import direction, rotation, vector

# Reach of a quadratic B-spline, in Δx.
_REACH = 1.5


def check_kind(kind: str, where: str) -> None:
    """Refuse an unknown kind of contact.

    Raises:
        ConfigError: names the kinds.
    """
    if kind not in KINDS:
        raise ConfigError(f"{where}.kind={kind!r} is unknown; choose one of {', '.join(KINDS)}")


@dataclass(frozen=True)
class Collider(ABC):
    """A rigid solid with a prescribed motion; its condition holds in its own moving frame.

    Attributes:
        kind: `sticky`, `slip` (no normal motion) or `separate` (may lift off).
        friction: Coulomb coefficient of `slip` and `separate`, dimensionless.
        motion: keyframes relative to the shape's pose, which is the pose at rest; None for none.
        since, until: [s] the collider acts in steps that start in [since, until); it moves at any time.

    Raises:
        ConfigError: unknown kind, negative friction, friction on `sticky`, since not in [0, until), a
            motion that begins after `until`, or a value of the shape that is refused.
    """

    motion: Motion | None = field(default=None, kw_only=True)
    since: float = field(default=0.0, kw_only=True)
    until: float = field(default=math.inf, kw_only=True)

    name: ClassVar[str]
    shape: ClassVar[int]

    def __post_init__(self):
        check_kind(self.kind, self.name)
        if not (self.friction >= 0 and math.isfinite(self.friction)):
            raise ConfigError(f"{self.name}.friction={self.friction} must be finite and at least 0")
        if self.kind == "sticky" and self.friction:
            raise ConfigError(
                f"{self.name}.friction={self.friction} has no effect on kind=sticky; use kind=separate"
            )
        if self.motion is not None and not isinstance(self.motion, Motion):
            raise ConfigError(
                f"{self.name}.motion={self.motion} must be a motion; give it _target_: nsf.mpm.Motion"
            )
        if not 0.0 <= self.since < self.until:
            raise ConfigError(
                f"{self.name}.since={self.since} s must be at least 0 and below until={self.until} s"
            )
        if self.motion is not None and self.until <= self.motion.times[0]:
            raise ConfigError(
                f"{self.name}.until={self.until} s ends before motion.times={self.motion.times} s begin; "
                "leave out one of them"
            )

    @property
    @abstractmethod
    def position(self) -> np.ndarray:
        """[3] reference point at rest [m]."""

    @property
    @abstractmethod
    def extents(self) -> np.ndarray:
        """[3] dimensions of this shape for the contact function."""

    @property
    @abstractmethod
    def bound(self) -> float:
        """Radius of the ball about `position` that holds the solid [m]."""

    @abstractmethod
    def _distance(self, arm: np.ndarray) -> np.ndarray:
        """[n] distance [m] from the surface; `arm` [n, 3] [m] from `position`, in the solid's axes."""

    def distance(self, x: np.ndarray, t: float = 0.0) -> np.ndarray:
        """[n] distance [m] of points x [n, 3] [m] from the surface at time t [s], negative inside."""
        at_rest = x if self.motion is None else self.motion.undone(x, t)
        return self._distance((at_rest - self.position) @ self.orientation)

    @property
    def orientation(self) -> np.ndarray:
        """[3, 3] rotation from the solid's axes to the domain's, at rest."""
        return np.eye(3)

    @property
    def coarsest_dx(self) -> float:
        """Largest grid spacing [m] that holds the shape."""
        return math.inf

    @property
    def changes(self) -> bool:
        """Whether the pose or the presence depends on time."""
        return self.motion is not None or self.since > 0.0 or self.until < math.inf

    def top_speed(self, upper: np.ndarray) -> float:
        """Bound on the speed [m/s] of the solid's points in the domain from 0 to `upper` [3] [m]."""
        if self.motion is None:
            return 0.0
        pivot, translations = self.motion.hinge()[1], self.motion.keyframes()[1]
        reach = float(np.linalg.norm(self.position - pivot)) + self.bound
        corner = float(np.linalg.norm(np.maximum(np.abs(pivot), np.abs(upper - pivot))))
        carried = float(np.linalg.norm(translations, axis=1).max())
        return self.motion.top_speed(min(reach, corner + carried))


@dataclass(frozen=True)
class HalfSpace(Collider):
    """The solid half-space {x : (x − point)·normal ≤ 0}; the material is on the other side.

    Attributes:
        point: a point of the surface [m].
        normal: outward normal, any length.
        kind, friction, motion, since, until: see `Collider`.

    Raises:
        ConfigError: zero normal, a value that is not finite; and see `Collider`.
    """

    point: Sequence[float]
    normal: Sequence[float]
    kind: str = "sticky"
    friction: float = 0.0

    name, shape, bound = "half-space", HALF_SPACE, math.inf

    def __post_init__(self):
        super().__post_init__()
        vector("half-space.point", self.point, "m")
        direction("half-space.normal", self.normal)

    @property
    def position(self) -> np.ndarray:
        """[3] the point."""
        return np.array(self.point, float)

    @property
    def extents(self) -> np.ndarray:
        """[3] unit normal."""
        return direction("half-space.normal", self.normal)

    def _distance(self, arm: np.ndarray) -> np.ndarray:
        return arm @ self.extents


@dataclass(frozen=True)
class Sphere(Collider):
    """A solid ball.

    Attributes:
        centre: [m].
        radius: [m], at least 1.5 Δx, so that nodes on all sides belong to it.
        kind, friction, motion, since, until: see `Collider`.

    Raises:
        ConfigError: a radius that is not positive, a value that is not finite; and see `Collider`.
    """

    centre: Sequence[float]
    radius: float
    kind: str = "sticky"
    friction: float = 0.0

    name, shape = "sphere", SPHERE

    def __post_init__(self):
        super().__post_init__()
        vector("sphere.centre", self.centre, "m")
        if not (self.radius > 0 and math.isfinite(self.radius)):
            raise ConfigError(f"sphere.radius={self.radius} m must be positive and finite")

    @property
    def position(self) -> np.ndarray:
        """[3] the centre."""
        return np.array(self.centre, float)

    @property
    def bound(self) -> float:
        """The radius [m]."""
        return self.radius

    @property
    def extents(self) -> np.ndarray:
        """[3] radius, 0, 0."""
        return np.array([self.radius, 0.0, 0.0])

    def _distance(self, arm: np.ndarray) -> np.ndarray:
        return np.linalg.norm(arm, axis=1) - self.radius

    @property
    def coarsest_dx(self) -> float:
        """Two thirds of the radius [m]."""
        return self.radius / _REACH


@dataclass(frozen=True)
class Cuboid(Collider):
    """A solid box at any angle: a grip, a plate or, when thin, a blade.

    A box thinner than 1.5 Δx holds the nodes within 0.75 Δx of its middle plane. At any angle no two
    neighbouring nodes lie on opposite sides of it. Along the grid's planes, quadratic B-splines of
    particles on its two sides meet in its own nodes only. Such a blade parts its two sides wholly if
    it is `sticky`. `slip` stops material that crosses the blade, while material that slides along
    both sides shares its nodes. `separate` must tell which side a node serves, which takes a
    thickness of 3 Δx.

    Attributes:
        centre: [m].
        size: edge lengths along its own axes [m].
        axis, angle: the box is turned by `angle` [°] about `axis` through its centre, right-handed.
        kind, friction, motion, since, until: see `Collider`.

    Raises:
        ConfigError: an edge that is not positive, a zero axis, a value that is not finite; and see
            `Collider`.
    """

    centre: Sequence[float]
    size: Sequence[float]
    kind: str = "sticky"
    friction: float = 0.0
    axis: Sequence[float] = (0.0, 0.0, 1.0)
    angle: float = 0.0

    name, shape = "cuboid", CUBOID

    def __post_init__(self):
        super().__post_init__()
        vector("cuboid.centre", self.centre, "m")
        if min(vector("cuboid.size", self.size, "m")) <= 0.0:
            raise ConfigError(f"cuboid.size={self.size} m must be positive along each axis")
        direction("cuboid.axis", self.axis)
        if not math.isfinite(self.angle):
            raise ConfigError(f"cuboid.angle={self.angle} ° must be finite")

    @property
    def position(self) -> np.ndarray:
        """[3] the centre."""
        return np.array(self.centre, float)

    @property
    def orientation(self) -> np.ndarray:
        """[3, 3] rotation by `angle` about `axis`."""
        return rotation(direction("cuboid.axis", self.axis), self.angle)

    @property
    def extents(self) -> np.ndarray:
        """[3] half edges."""
        return 0.5 * np.array(self.size, float)

    def _distance(self, arm: np.ndarray) -> np.ndarray:
        beyond = np.abs(arm) - self.extents
        return np.linalg.norm(np.maximum(beyond, 0.0), axis=1) + np.minimum(beyond.max(1), 0.0)

    @property
    def bound(self) -> float:
        """Half the diagonal [m]."""
        return float(np.linalg.norm(self.extents))

    @property
    def coarsest_dx(self) -> float:
        """For `separate`, a third of the least edge [m]."""
        return min(self.size) / (2.0 * _REACH) if self.kind == "separate" else math.inf


def floor_height(colliders: Sequence[Collider]) -> float | None:
    """Height [m] of a horizontal floor at rest, for pictures; None where there is none."""
    planes = [c for c in colliders if isinstance(c, HalfSpace) and not c.changes]
    heights = [c.point[2] for c in planes if np.allclose(c.extents, (0.0, 0.0, 1.0))]
    return float(heights[0]) if heights else None
