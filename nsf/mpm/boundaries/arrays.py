"""All solids and walls on the device, where the solids follow their keyframes."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import warp as wp

from nsf.mpm.boundaries.colliders import Collider
from nsf.mpm.boundaries.contact import KINDS
from nsf.mpm.boundaries.motion import Motion
from nsf.mpm.boundaries.walls import DomainWalls
from nsf.mpm.precision import Precision

# A time this near to `since` or `until` (in steps) is that time, in spite of round-off.
_SAME_TIME = 1e-6
# Keyframes of a solid that a hand moves.
_BY_HAND = 2
_AT_REST = Motion((0.0, 1.0), ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)))


@cache
def make_solids(precision: Precision):
    """Warp struct of colliders and walls for kernels; fields as in `BoundaryArrays`."""
    real, vec3, mat33 = precision.real, precision.vec3, precision.mat33

    @wp.struct
    class Solids:
        shape: wp.array(dtype=wp.int32)
        active: wp.array(dtype=wp.int32)
        position: wp.array(dtype=vec3)
        orientation: wp.array(dtype=mat33)
        extents: wp.array(dtype=vec3)
        velocity: wp.array(dtype=vec3)
        gradient: wp.array(dtype=mat33)
        kind: wp.array(dtype=wp.int32)
        friction: wp.array(dtype=real)
        wall_kind: wp.int32
        wall_padding: wp.int32

    return Solids


class BoundaryArrays:
    """Colliders and walls on the device.

    `steps`, on the device, counts the time, so that a step captured in a graph moves the colliders, too.
    Solvers that take turns at one simulation (the phases of a reduced run) share one object.

    Args:
        colliders: applied in order.
        walls: condition on the faces of the domain.
        precision: of the kernel.
        device: Warp device.

    Attributes:
        colliders: as they are now; a solid that a hand moves has its motion. walls: as given.
        shape: [c] code of the shape.
        active: [c] whether the collider acts in this step.
        position: [c, 3] [m]; orientation: [c, 3, 3]; both at the start t^n of the step.
        extents: [c, 3] see `Collider.extents`.
        velocity: [c, 3] mean velocity of the point at `position` over the step [m/s].
        gradient: [c, 3, 3] gradient of this velocity in space [1/s].
        kind: [c] code of the contact; friction: [c].
        steps: [c] steps taken.
        changes: whether a collider moves, or acts at some times only.
        solids: the struct of these arrays and of the walls that the kernels take.
    """

    def __init__(self, colliders: Sequence[Collider], walls: DomainWalls, precision: Precision, device):
        self.colliders, self.walls, self._device = tuple(colliders), walls, device
        self._programs = self.colliders
        count = len(self.colliders)

        def array(values, dtype, *entry: int):
            # Without a collider, NumPy cannot tell the shape of an entry.
            return wp.array(np.array(values, float).reshape(-1, *entry), dtype=dtype, device=device)

        positions, turns = ([getattr(c, k) for c in self.colliders] for k in ("position", "orientation"))
        self.shape = wp.array([c.shape for c in self.colliders], dtype=wp.int32, device=device)
        self.active = wp.full(count, 1, dtype=wp.int32, device=device)
        self.position = array(positions, precision.vec3, 3)
        self.orientation = array(turns, precision.mat33, 3, 3)
        self.extents = array([c.extents for c in self.colliders], precision.vec3, 3)
        self.velocity = wp.zeros(count, dtype=precision.vec3, device=device)
        self.gradient = wp.zeros(count, dtype=precision.mat33, device=device)
        self.kind = wp.array([KINDS[c.kind] for c in self.colliders], dtype=wp.int32, device=device)
        self.friction = array([c.friction for c in self.colliders], precision.real)
        self.steps = wp.zeros(count, dtype=wp.int32, device=device)
        self.solids = make_solids(precision)()
        for name in ("shape", "active", "position", "orientation", "extents", "velocity", "gradient"):
            setattr(self.solids, name, getattr(self, name))
        self.solids.kind, self.solids.friction = self.kind, self.friction
        self.solids.wall_kind, self.solids.wall_padding = KINDS[walls.kind], walls.padding
        self.changes = any(c.changes for c in self.colliders)
        if not self.changes:
            return
        self._follow = make_follow(precision)
        motions = [c.motion or _AT_REST for c in self.colliders]
        times, translations, angles = zip(*(m.keyframes() for m in motions), strict=True)
        axes, pivots = zip(*(m.hinge() for m in motions), strict=True)
        # The first two keyframes of each solid are a hand's.
        ends = np.cumsum([_BY_HAND + len(t) for t in times])
        self._keyframe_rows = np.array([0, *ends[:-1]]) + _BY_HAND, ends - 1
        self._keyframes = [
            np.concatenate([part for keys in lists for part in (np.zeros_like(keys[:_BY_HAND]), keys)])
            for lists in (times, translations, angles)
        ]
        self._prescribed = [
            array(self._keyframes[0], wp.float64),
            array(self._keyframes[1], wp.vec3d, 3),
            array(self._keyframes[2], wp.float64),
            *(wp.array(which, dtype=wp.int32, device=device) for which in self._keyframe_rows),
            array(axes, wp.vec3d, 3),
            array(pivots, wp.vec3d, 3),
            array(positions, wp.vec3d, 3),
            array(turns, wp.mat33d, 3, 3),
            array([c.since for c in self.colliders], wp.float64),
            array([c.until for c in self.colliders], wp.float64),
        ]

    def start_from(self, steps: int) -> None:
        """Let the next step be the one that starts `steps` steps after t = 0."""
        self.steps.fill_(steps)

    def move(self, collider: int, motion: Motion) -> None:
        """Another motion of two keyframes for a solid that moves, in place of its own, with its axis."""
        self.colliders = tuple(
            replace(solid, motion=motion) if c == collider else solid
            for c, solid in enumerate(self.colliders)
        )
        first = int(self._keyframe_rows[0][collider]) - _BY_HAND
        for keys, values, array in zip(self._keyframes, motion.keyframes(), self._prescribed, strict=False):
            keys[first : first + _BY_HAND] = values
            array.assign(keys)
        self._point()

    def release(self) -> None:
        """Every solid follows its own motion again."""
        if self.colliders is not self._programs:
            self.colliders = self._programs
            self._point()

    def _point(self) -> None:
        """Assign to each solid the keyframes that the kernel follows."""
        steered = np.array([a is not b for a, b in zip(self.colliders, self._programs, strict=True)])
        first, last = self._keyframe_rows
        begin = np.where(steered, first - _BY_HAND, first)
        end = np.where(steered, begin + _BY_HAND - 1, last)
        for array, values in zip(self._prescribed[3:5], (begin, end), strict=True):
            array.assign(values.astype(np.int32))

    def advance(self, dt: float) -> None:
        """Set pose and velocity of every collider for the next step of dt [s], if any of them changes."""
        if not self.changes:
            return
        outputs = [self.active, self.position, self.orientation, self.velocity, self.gradient]
        inputs = [*self._prescribed, dt, self.steps, *outputs]
        wp.launch(self._follow, dim=len(self.colliders), inputs=inputs, device=self._device)


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
