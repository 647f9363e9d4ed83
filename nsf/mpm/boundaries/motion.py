"""Prescribed motion of a solid, by keyframes; `nsf.mpm.boundaries.arrays` follows them on the device."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nsf.errors import ConfigError
from nsf.vectors import direction, is_list, numbers, rotation, vector

# For how long a solid goes on as a hand left it [s].
_STEERED = 1e4


@dataclass(frozen=True)
class Motion:
    """Keyframes of a rigid motion, relative to the pose at rest.

    The point X of the solid is at pivot + R(θ)(X − pivot) + d. The translation d and the angle θ are
    linear between keyframes, constant before the first and after the last. With a tilt, the solid and its
    way are turned by it as one: θ is larger by it, and d is turned.

    Attributes:
        times: [k] times of the keyframes [s], ascending.
        translations: [k, 3] d [m]; none if left out.
        angles: [k] θ about `axis`, right-handed [°]; none if left out.
        axis: [3] axis of the rotation, any length.
        pivot: [3] a point of the axis, at rest [m]; the translation carries it along.
        tilt: of the solid and its whole way about `axis` through `pivot` [°]; None for none.

    Raises:
        ConfigError: fewer than 2 keyframes, times that do not ascend from 0 s on, lists that differ
            in length, neither translations nor angles, angles or a tilt without axis and pivot or the
            reverse, a value that is not finite.
    """

    times: Sequence[float]
    translations: Sequence[Sequence[float]] = ()
    angles: Sequence[float] = ()
    axis: Sequence[float] | None = None
    pivot: Sequence[float] | None = None
    tilt: float | None = None

    def __post_init__(self):
        times = numbers("motion.times", self.times, "s")
        if len(times) < 2 or times[0] < 0.0 or (np.diff(times) <= 0.0).any():
            raise ConfigError(
                f"motion.times={self.times} s must be at least 2 and ascend from 0 s on; "
                "leave out the motion of a solid at rest"
            )
        for name in ("translations", "angles"):
            values = getattr(self, name)
            if not is_list(values) or len(values) not in (0, len(times)):
                raise ConfigError(
                    f"motion.{name}={values} must be a list of {len(times)} keyframes, as motion.times is"
                )
        if not len(self.translations) and not len(self.angles):
            raise ConfigError(
                "motion has neither translations nor angles; give one of them a keyframe a time"
            )
        for d in self.translations:
            vector("motion.translations", d, "m")
        numbers("motion.angles", self.angles, "°")
        if self.turns:
            direction("motion.axis", self.axis)
            vector("motion.pivot", self.pivot, "m")
            numbers("motion.tilt", [self.tilt or 0.0], "°")
        elif self.axis is not None or self.pivot is not None:
            raise ConfigError(
                f"motion.axis={self.axis} and motion.pivot={self.pivot} have no effect without "
                "motion.angles or motion.tilt; leave them out"
            )

    @property
    def turns(self) -> bool:
        """Whether the solid is turned."""
        return len(self.angles) > 0 or self.tilt is not None

    def keyframes(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Times [k] [s], translations [k, 3] [m] and angles [k] [rad]."""
        k = len(self.times)
        translations = np.array(self.translations, float) if len(self.translations) else np.zeros((k, 3))
        angles = np.radians(self.angles) if len(self.angles) else np.zeros(k)
        if self.tilt is not None:
            turn = rotation(self.hinge()[0], self.tilt)
            translations = np.array([turn @ d for d in translations])
            angles = angles + np.radians(self.tilt)
        return np.array(self.times, float), translations, angles

    def hinge(self) -> tuple[np.ndarray, np.ndarray]:
        """Unit axis [3] and pivot [3] [m]; the origin if the motion has no rotation."""
        if not self.turns:
            return np.array([0.0, 0.0, 1.0]), np.zeros(3)
        return direction("motion.axis", self.axis), np.array(self.pivot, float)

    def pose(self, t: np.ndarray | float) -> np.ndarray:
        """d [m] and θ [rad] at times t [...] [s]: [..., 4]."""
        times, translations, angles = self.keyframes()
        return np.stack([np.interp(t, times, way) for way in (*translations.T, angles)], axis=-1)

    def undone(self, x: np.ndarray, t: float) -> np.ndarray:
        """Where points x [n, 3] [m] of the solid at time t [s] lie at rest [m]."""
        (*d, angle), (axis, pivot) = self.pose(t), self.hinge()
        return (x - (pivot + d)) @ rotation(axis, np.degrees(angle)) + pivot

    def steered(self, t: float, velocity: np.ndarray, spin: float) -> "Motion":
        """The motion that goes on from time t [s] at a velocity [3] [m/s] and a spin about `axis` [°/s]."""
        pose, turned = self.pose(t), {}
        d = pose[:3]
        if self.turns:
            angle = float(np.degrees(pose[3]))
            turned = {"angles": (angle, angle + _STEERED * spin), "axis": self.axis, "pivot": self.pivot}
        elif spin:
            raise ConfigError(
                f"spin={spin:g} °/s: the solid's own motion has no axis; give its motion angles"
            )
        return Motion((t, t + _STEERED), (tuple(d), tuple(d + _STEERED * velocity)), **turned)

    def top_speed(self, reach: float) -> float:
        """Bound on the speed [m/s] of the solid's points within `reach` [m] of the pivot."""
        times, translations, angles = self.keyframes()
        speed = np.linalg.norm(np.diff(translations, axis=0), axis=1)
        if self.turns:
            speed = speed + reach * np.abs(np.diff(angles))
        return float((speed / np.diff(times)).max())
