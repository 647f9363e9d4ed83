"""B-spline interpolation weights on the background grid (paper section 3.2)."""

from dataclasses import dataclass
from functools import cache
from typing import Any

from nsf.mpm.precision import Precision
from nsf.scalars import one_of

DEGREES = {"quadratic": 2, "cubic": 3}


@dataclass(frozen=True)
class ShapeFunctions:
    """The Warp functions of one B-spline degree and precision.

    Attributes:
        degree: B-spline degree b (2 or 3); a particle sees b + 1 nodes an axis.
        base_node: (x [m], 1/dx) → lowest node index of the particle's stencil.
        local: (x [m], 1/dx, base) → position relative to the base node [dx].
        weights: local position → [3, b + 1] weights w, one row an axis.
        gradients: local position → [3, b + 1] derivatives dw/d(x/dx).
        entry: (weights or gradients, axis, i) → entry i of an axis, for an i that is known only at run time.
    """

    degree: int
    base_node: Any
    local: Any
    weights: Any
    gradients: Any
    entry: Any

    @property
    def affine_inertia(self) -> float:
        """D in units of dx²: Σ w (x_i − x_p)(x_i − x_p)ᵀ = D dx² I, which is (b + 1)/12."""
        return (self.degree + 1) / 12.0


def stencil_offset(name: str) -> float:
    """Least distance from a particle down to its stencil [dx]: 1/2 for `quadratic`, 1 for `cubic`."""
    return 0.5 * (DEGREES[name] - 1)


@cache
def shape_functions(precision: Precision, name: str) -> ShapeFunctions:
    """Build the interpolation functions of B-spline `name`.

    Args:
        precision: floating-point types.
        name: `quadratic` or `cubic`.

    Raises:
        ConfigError: the name is unknown.

    Source: Jiang et al. 2016, The material point method, eqs. 122-123.
    """
    import warp as wp

    degree = DEGREES[one_of("shape", name, DEGREES)]
    real, vec3 = precision.real, precision.vec3
    stencil = wp.types.matrix(shape=(3, degree + 1), dtype=real)
    offset = stencil_offset(name)

    @wp.func
    def base_node(x: vec3, inv_dx: real):
        return wp.vec3i(
            int(wp.floor(x[0] * inv_dx - real(offset))),
            int(wp.floor(x[1] * inv_dx - real(offset))),
            int(wp.floor(x[2] * inv_dx - real(offset))),
        )

    @wp.func
    def local(x: vec3, inv_dx: real, base: wp.vec3i):
        return vec3(
            x[0] * inv_dx - real(base[0]), x[1] * inv_dx - real(base[1]), x[2] * inv_dx - real(base[2])
        )

    @wp.func
    def entry(values: stencil, axis: int, i: int):
        value = values[axis, 0]
        for j in range(1, wp.static(degree + 1)):  # a matrix whose index is unknown would lie in memory
            value = wp.where(i == j, values[axis, j], value)
        return value

    if degree == 2:

        @wp.func
        def weights(f: vec3):
            w = stencil()
            for axis in range(3):
                low = real(1.5) - f[axis]
                mid = f[axis] - real(1.0)
                high = f[axis] - real(0.5)
                w[axis, 0] = real(0.5) * low * low
                w[axis, 1] = real(0.75) - mid * mid
                w[axis, 2] = real(0.5) * high * high
            return w

        @wp.func
        def gradients(f: vec3):
            d = stencil()
            for axis in range(3):
                d[axis, 0] = f[axis] - real(1.5)
                d[axis, 1] = real(-2.0) * (f[axis] - real(1.0))
                d[axis, 2] = f[axis] - real(0.5)
            return d

    else:

        @wp.func
        def weights(f: vec3):
            w = stencil()
            for axis in range(3):
                s = f[axis] - real(1.0)
                t = real(1.0) - s
                w[axis, 0] = t * t * t / real(6.0)
                w[axis, 1] = real(0.5) * s * s * s - s * s + real(2.0) / real(3.0)
                w[axis, 2] = real(0.5) * t * t * t - t * t + real(2.0) / real(3.0)
                w[axis, 3] = s * s * s / real(6.0)
            return w

        @wp.func
        def gradients(f: vec3):
            d = stencil()
            for axis in range(3):
                s = f[axis] - real(1.0)
                t = real(1.0) - s
                d[axis, 0] = real(-0.5) * t * t
                d[axis, 1] = real(1.5) * s * s - real(2.0) * s
                d[axis, 2] = real(2.0) * t - real(1.5) * t * t
                d[axis, 3] = real(0.5) * s * s
            return d

    return ShapeFunctions(degree, base_node, local, weights, gradients, entry)
