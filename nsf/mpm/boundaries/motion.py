"""Prescribed motion of a solid: its keyframes, and the kernel that follows them on the device."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
import warp as wp

from nsf.errors import ConfigError
from nsf.mpm.precision import Precision
from nsf.vectors import direction, is_list, numbers, rotation, vector

# For how long a solid goes on as a hand left it [s].
_STEERED = 1e4
# A time this near to `since` or `until` (in steps) is that time, in spite of round-off.
_SAME_TIME = 1e-6


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


@wp.func
def keyframe_before(times: wp.array(dtype=wp.float64), first: int, last: int, t: wp.float64):
    """Index of the keyframe at or before t, and the fraction of the way to the next."""
    if t <= times[first] or first == last:
        return first, wp.float64(0.0)
    k = first
    while k < last - 1 and times[k + 1] < t:
        k += 1
    return k, wp.min((t - times[k]) / (times[k + 1] - times[k]), wp.float64(1.0))


@cache
def make_follow(precision: Precision):
    """Kernel that puts each solid at its pose at t^n and gives the solid's velocity over the step from there.

    t^n is the time of the particles that P2G takes to the grid. The velocity of the solid's point at x
    is the mean over [t^n, t^{n+1}], which is (x^{n+1} − x)/Δt. Material that sticks to the solid is then
    displaced as the solid is: whatever the keyframes and Δt, translations add up exactly and rotations
    stay rigid (f_p = R). ω × r at t^n would spiral outward, by ½(ω Δt)² r a step. The mean velocity is
    linear in x, so a velocity and its gradient hold it:
    v(x) = velocity + gradient (x − position), gradient = (R − I)/Δt = ω × + O(Δt).

    Each solid counts its own steps, so that time stays on the device and a captured graph replays. The
    kernel is fp64 in either precision, because velocities are differences of near positions.
    """
    vec3, mat33 = precision.vec3, precision.mat33
    f64, vec3d, mat33d = wp.float64, wp.vec3d, wp.mat33d

    @wp.func
    def rotation_less_identity(axis: vec3d, angle: f64):
        K = wp.skew(axis)
        half = wp.sin(f64(0.5) * angle)
        return wp.sin(angle) * K + (f64(2.0) * half * half) * (K * K)

    @wp.kernel(enable_backward=False, module="unique")
    def follow(
        times: wp.array(dtype=f64),
        translations: wp.array(dtype=vec3d),
        angles: wp.array(dtype=f64),
        first: wp.array(dtype=wp.int32),
        last: wp.array(dtype=wp.int32),
        axis: wp.array(dtype=vec3d),
        pivot: wp.array(dtype=vec3d),
        rest_position: wp.array(dtype=vec3d),
        rest_orientation: wp.array(dtype=mat33d),
        since: wp.array(dtype=f64),
        until: wp.array(dtype=f64),
        dt: f64,
        steps: wp.array(dtype=wp.int32),
        active: wp.array(dtype=wp.int32),
        position: wp.array(dtype=vec3),
        orientation: wp.array(dtype=mat33),
        velocity: wp.array(dtype=vec3),
        gradient: wp.array(dtype=mat33),
    ):
        c = wp.tid()
        n = steps[c]
        steps[c] = n + 1
        t = f64(n) * dt
        later = t + f64(wp.static(_SAME_TIME)) * dt
        active[c] = int(later >= since[c] and later < until[c])
        k, share = keyframe_before(times, first[c], last[c], t)
        d = wp.lerp(translations[k], translations[k + 1], share)
        angle = wp.lerp(angles[k], angles[k + 1], share)
        k, share = keyframe_before(times, first[c], last[c], f64(n + 1) * dt)
        moved = wp.lerp(translations[k], translations[k + 1], share) - d
        turn = rotation_less_identity(axis[c], wp.lerp(angles[k], angles[k + 1], share) - angle)
        pose = wp.identity(n=3, dtype=f64) + rotation_less_identity(axis[c], angle)
        arm = pose * (rest_position[c] - pivot[c])
        position[c] = vec3(pivot[c] + d + arm)
        orientation[c] = mat33(pose * rest_orientation[c])
        velocity[c] = vec3((moved + turn * arm) / dt)
        gradient[c] = mat33(turn / dt)

    return follow
