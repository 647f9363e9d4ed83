"""Keyframes of solids, followed on the device."""

from functools import cache

import warp as wp

from nsf.mpm.precision import Precision

# A time this near to `since` or `until` (in steps) is that time, in spite of round-off.
_SAME_TIME = 1e-6


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
