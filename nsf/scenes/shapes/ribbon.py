"""A round ribbon along a path, as toothpaste leaves its tube."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nsf.errors import ConfigError
from nsf.scalars import length
from nsf.scenes.shapes.geometry import Shape
from nsf.vectors import vector

# Radii along a path: its check for coming back looks at four points a radius, each with each.
_LONGEST = 5000
# A path that just fits passes, whatever its last digits.
_LENIENT = 1.0 - 1e-9


@dataclass(frozen=True)
class Ribbon(Shape):
    """All points within `radius` of a path of straight pieces, so with rounded ends and bends.

    Attributes:
        path: two or more points [m]; many near ones make a smooth path.
        radius: [m].

    Raises:
        ConfigError: too few points, two equal ones in a row, a radius too thin for the path's length, a
            bend too sharp for the radius, or a path that comes back to within 2 radius of itself. The
            volume would not be the one given.
    """

    path: Sequence[Sequence[float]]
    radius: float

    def __post_init__(self):
        length("ribbon radius", self.radius)
        if len(self.path) < 2:
            raise ConfigError(f"ribbon path={self.path} must have at least 2 points")
        for point in self.path:
            vector("ribbon path point", point, "m")
        self._check_pieces()
        if not (long := float(self._pieces()[0].sum())) <= _LONGEST * self.radius:
            raise ConfigError(
                f"ribbon radius={self.radius} m is less than a {_LONGEST}th of its path of {long:.3g} m, "
                "which no grid resolves; take a larger radius or a shorter path"
            )
        self._check_bends()
        self._check_distance()

    def _points(self) -> np.ndarray:
        return np.asarray(self.path, float)

    def _pieces(self) -> tuple[np.ndarray, np.ndarray]:
        """Length [m] and direction of each piece."""
        pieces = np.diff(self._points(), axis=0)
        lengths = np.linalg.norm(pieces, axis=1)
        return lengths, pieces / lengths[:, None]

    def _bends(self) -> np.ndarray:
        """Angle between each piece and the next [rad]."""
        _, along = self._pieces()
        # By the tangent: the arc cosine of nearly 1 has half of the digits.
        sine = np.linalg.norm(np.cross(along[:-1], along[1:]), axis=1)
        return np.arctan2(sine, (along[:-1] * along[1:]).sum(1))

    def _check_pieces(self) -> None:
        equal = np.flatnonzero(~np.diff(self._points(), axis=0).any(1))
        if len(equal):
            raise ConfigError(f"ribbon path has {self.path[equal[0]]} m twice in a row; leave one out")

    def _reach(self) -> np.ndarray:
        """How far the overlap at each point's bend reaches along its pieces, none at the ends [m]."""
        return np.concatenate([[0.0], self.radius * np.tan(0.5 * self._bends()), [0.0]])

    def _check_bends(self) -> None:
        """The overlaps of two bends in a row must not meet."""
        lengths, _ = self._pieces()
        reach = self._reach() * _LENIENT
        tight = np.flatnonzero(reach[:-1] + reach[1:] > lengths)
        if len(tight):
            at = self.path[tight[0]]
            raise ConfigError(
                f"ribbon radius={self.radius} m is too large for the bends of its path near {at} m; "
                "take a smaller radius or a smoother path"
            )

    def _check_distance(self) -> None:
        """Points beyond half a turn of radius r from each other must be 2 r apart.

        Within half a turn, a path that passes `_check_bends` cannot come back. A bend counts as
        long as the arc of radius r that touches both of its pieces.
        """
        lengths, along = self._pieces()
        counts = np.ceil(lengths / (0.25 * self.radius)).astype(int)
        piece = np.repeat(np.arange(len(lengths)), counts)
        k = np.arange(len(piece)) - np.repeat(np.cumsum(counts) - counts, counts)
        t = (k + 0.5) / counts[piece] * lengths[piece]
        points = self._points()[piece] + t[:, None] * along[piece]

        starts, reach = np.cumsum(lengths) - lengths, self._reach()
        bend = 0.5 * self.radius * np.concatenate([[0.0], self._bends(), [0.0]])
        straight = lengths - reach[:-1] - reach[1:]
        ends = np.stack([starts, starts + reach[:-1], starts + lengths - reach[1:]], 1).ravel()
        arcs = np.cumsum(np.stack([bend[:-1], straight, bend[1:]], 1).ravel())
        arc = np.interp(starts[piece] + t, np.append(ends, lengths.sum()), np.concatenate([[0.0], arcs]))

        for i, here in enumerate(points):
            far = (arc - arc[i] > np.pi * self.radius) & (piece > piece[i] + 1)
            close = far & (np.linalg.norm(points - here, axis=1) < 2.0 * self.radius * _LENIENT)
            if close.any():
                raise ConfigError(
                    f"ribbon path comes within 2 radius={2.0 * self.radius:g} m of itself at {here} and "
                    f"{points[np.argmax(close)]} m; take a smaller radius or lead it further apart"
                )

    @property
    def volume(self) -> float:
        """Volume [m³], exact.

        Cylinders, half a ball at each end, and at a bend by θ a wedge of a ball, 2/3 r³ θ, in
        place of the overlap of two cylinders, 4/3 r³ tan(θ/2).
        """
        lengths, _ = self._pieces()
        bend, r = self._bends(), float(self.radius)
        corners = (2.0 / 3.0 * bend - 4.0 / 3.0 * np.tan(0.5 * bend)).sum()
        return float(np.pi * r**2 * lengths.sum() + r**3 * (4.0 / 3.0 * np.pi + corners))

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Corners [m]."""
        points = self._points()
        return points.min(0) - self.radius, points.max(0) + self.radius

    def contains(self, x: np.ndarray) -> np.ndarray:
        """Whether each point lies inside."""
        inside = np.zeros(len(x), bool)
        for start, size, along in zip(self._points(), *self._pieces(), strict=False):
            d = x - start
            t = np.clip(d @ along, 0.0, size)
            inside |= ((d - t[:, None] * along) ** 2).sum(1) <= self.radius**2
        return inside
