"""Contact of a grid node with a solid: whether the node is inside, and the velocity it keeps."""

from functools import cache

from nsf.mpm.precision import Precision

# Kinds of contact. Sticky: no motion. Slip: no normal motion. Separate: no motion into the solid.
STICKY, SLIP, SEPARATE = 0, 1, 2
KINDS = {"sticky": STICKY, "slip": SLIP, "separate": SEPARATE}
HALF_SPACE, SPHERE, CUBOID = 0, 1, 2
# A node this near to a surface (in Δx) lies on it and belongs to the solid, in spite of round-off.
_ON_SURFACE = 1e-4
#: Least half thickness of a cuboid (in Δx): half the reach of a quadratic B-spline. Particles on the two
#: sides of a blade this thick share no node but the blade's, where it lies along the grid's planes; at any
#: angle no two neighbouring nodes lie on opposite sides of it.
THINNEST = 0.75


@cache
def make_contact(precision: Precision):
    """Functions (outward_normal, against) of one precision.

    Source: Coulomb friction, Stomakhin et al. 2013, section 8.
    """
    import warp as wp

    real, vec3, mat33 = precision.real, precision.vec3, precision.mat33

    @wp.func
    def cuboid_normal(arm: vec3, orientation: mat33, half: vec3, dx: real):
        local = wp.transpose(orientation) * arm
        face = 0
        nearest = real(-wp.inf)
        for a in range(3):
            outside = wp.abs(local[a]) - wp.max(half[a], real(wp.static(THINNEST)) * dx)
            if outside > nearest:
                nearest = outside
                face = a
        normal = vec3()
        if nearest <= real(wp.static(_ON_SURFACE)) * dx:
            normal = vec3(orientation[0, face], orientation[1, face], orientation[2, face])
            if local[face] < real(0.0):
                normal = -normal
        return normal

    @wp.func
    def sphere_normal(arm: vec3, radius: real, dx: real):
        distance = wp.length(arm)
        normal = vec3()
        if distance <= radius + real(wp.static(_ON_SURFACE)) * dx:
            normal = vec3(real(0.0), real(0.0), real(1.0))  # any, at the centre
            if distance > real(0.0):
                normal = arm / distance
        return normal

    @wp.func
    def outward_normal(shape: int, arm: vec3, orientation: mat33, extents: vec3, dx: real):
        """Unit normal of the surface nearest to a node of the solid; zero for a node outside it.

        `arm` is from the solid's position to the node. `extents`: outward normal of a half-space at
        rest, radius of a sphere and 0 0, half edges of a cuboid.
        """
        if shape == wp.static(CUBOID):
            return cuboid_normal(arm, orientation, extents, dx)
        if shape == wp.static(SPHERE):
            return sphere_normal(arm, extents[0], dx)
        normal = orientation * extents
        if wp.dot(arm, normal) > real(wp.static(_ON_SURFACE)) * dx:
            normal = vec3()
        return normal

    @wp.func
    def against(v: vec3, normal: vec3, kind: int, friction: real):
        """The part of a velocity that a surface at rest leaves."""
        if kind == wp.static(STICKY):
            return vec3()
        normal_speed = wp.dot(v, normal)
        if kind == wp.static(SEPARATE) and normal_speed >= real(0.0):
            return v
        tangential = v - normal_speed * normal
        speed = wp.length(tangential)
        slow_down = friction * wp.max(-normal_speed, real(0.0))
        if speed <= slow_down:
            return vec3()
        if speed > real(0.0):
            tangential = tangential * (real(1.0) - slow_down / speed)
        return tangential

    return outward_normal, against
