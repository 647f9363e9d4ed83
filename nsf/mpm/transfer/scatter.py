"""Adds what particles carry to the nodes of a GPU's grid: a thread a node, for the particles of a warp."""

from functools import cache

import warp as wp

from nsf.mpm.native import native_code
from nsf.mpm.native.access import WARP
from nsf.mpm.precision import Precision

#: Threads of a block, whose shared memory holds what each of its particles carries.
THREADS = 64
_FEWEST, _WARPS = 8, 2**14  # particles of a warp; warps that keep a GPU busy


def particles_of_warp(particles: int) -> int:
    """How many particles each warp has: the fewer, the sooner it is done; and the more of a cell, the better.

    Args:
        particles: of all warps.
    """
    each = WARP
    while each > _FEWEST and particles <= each // 2 * _WARPS:
        each //= 2
    return each


@cache
def make_scatter(precision: Precision, width: int):
    """Warp function of what the particles of a warp give to the nodes of their stencils.

    All threads of a warp call it, each with a particle and the flat index of its cell, the first node of the
    stencil, or −1 without one. A thread then takes a node, and adds up what particles of one cell that follow
    each other give it. Where the next cell along the last axis follows, the sum is handed on to the thread
    that has the node there; else it is added to memory. Node (i, j, k) of the stencil gets w_ip m_p [kg] and
    w_ip (momentum + affine (i, j, k)) + impulse ∇w_ip [kg m/s]. The momentum is that at the first node x_0,
    m_p (v_p + C_p (x_0 − x_p)); affine is m_p Δx C_p, impulse −Δt V_p⁰ τ_p/Δx, and ∇ is along x/Δx. Nodes are
    stored at `start` + `slots`. Blocks have `THREADS` threads.

    Args:
        precision: of the values, whose array starts where an allocation does, so that each is aligned.
        width: nodes of a stencil along an axis; weights w and their derivatives d are [3, width].

    Source: paper section 3.3, steps 1 and 2.
    """
    real, vec3, vec4, mat33 = precision.real, precision.vec3, precision.vec4, precision.mat33
    stencil = wp.types.matrix(shape=(3, width), dtype=real)

    @wp.func_native(
        native_code("nsf.mpm", "scatter", real=precision.native, WIDTH=width, WARPS=THREADS // WARP)
    )
    def scatter(
        cell: int,
        start: int,
        w: stencil,
        d: stencil,
        mass: real,
        momentum: vec3,
        affine: mat33,
        impulse: mat33,
        shape: wp.vec3i,
        slots: wp.array(dtype=wp.int32),
        values: wp.array(dtype=vec4),
    ): ...

    return scatter


@wp.func_native("return __any_sync(0xffffffffu, mine);")
def any_of_warp(mine: bool) -> bool:
    """Whether it is so for any thread of a warp, all of which call it."""
    ...
