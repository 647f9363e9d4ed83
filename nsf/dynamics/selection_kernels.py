"""Kernels that find at each step, on the device, the integration particles that it needs."""

from functools import cache

import warp as wp

from nsf.mpm import Precision
from nsf.mpm.copies import make_copies
from nsf.mpm.grid import inside
from nsf.mpm.shape import shape_functions

# Adds `taken`, 0 or 1, to count[copy, 0]; threads of a warp that are of one simulation add together.
_COUNT = """
#if defined(__CUDA_ARCH__)
    unsigned long long* at = (unsigned long long*)count.data + size_t(copy) * count.shape[1];
#if __CUDA_ARCH__ >= 700
    const unsigned there = __activemask();
    const unsigned own = __match_any_sync(there, copy);
    const unsigned takers = __ballot_sync(there, taken != 0) & own;
    const bool first = (threadIdx.x & 31) == __ffs(own) - 1;
    if (first && takers != 0) atomicAdd(at, (unsigned long long)__popc(takers));
#else
    if (taken != 0) atomicAdd(at, 1ull);
#endif
#else
    count.data[size_t(copy) * count.shape[1]] += taken;
#endif
"""


@cache
def make_selection(precision: Precision, shape_name: str, several: bool = False):
    """Kernels that find the particles which the step of S needs, exactly as in the paper.

    `stamp` writes the number of the step to every cell from which a stencil meets one of S's, `select` takes
    S and the particles in these cells, and moves the others off the grid, where the transfers pass over them.
    Cells are those of a box that starts at `lower`, of which each simulation has its own.

    Source: paper section 5.4, a and b.
    """
    real, vec3 = precision.real, precision.vec3
    shape = shape_functions(precision, shape_name)
    base_node, reach = shape.base_node, shape.degree
    across = 2 * reach + 1
    share, copy_of = make_copies(several)

    @wp.func_native(_COUNT)
    def add_up(count: wp.array2d(dtype=wp.int64), copy: int, taken: int): ...

    @wp.func
    def cell(base: wp.vec3i, lower: wp.vec3i, extent: wp.vec3i):
        at = base - lower
        if not inside(at, 1, extent):
            return -1
        return (at[0] * extent[1] + at[1]) * extent[2] + at[2]

    @wp.kernel(enable_backward=False, module="unique", grid_stride=False)
    def stamp(
        x: wp.array(dtype=vec3),
        inv_dx: real,
        lower: wp.vec3i,
        extent: wp.vec3i,
        step: wp.array(dtype=wp.int32),
        stamps: wp.array2d(dtype=wp.int32),
        sample: int,
    ):
        t = wp.tid()
        of_sample, offset = t / wp.static(across**3), t % wp.static(across**3)
        copy = copy_of(of_sample, sample)
        p = of_sample + copy * (share(x.shape[0], step.shape[0]) - sample)
        base = base_node(x[p], inv_dx)
        place = wp.vec3i(offset / (across * across), (offset / across) % across, offset % across)
        c = cell(base + place - wp.vec3i(reach, reach, reach), lower, extent)
        if c >= 0:
            stamps[copy, c] = step[copy]

    @wp.kernel(enable_backward=False, module="unique", grid_stride=False)
    def select(
        inv_dx: real,
        lower: wp.vec3i,
        extent: wp.vec3i,
        step: wp.array(dtype=wp.int32),
        stamps: wp.array2d(dtype=wp.int32),
        sample: int,
        grid_shape: wp.vec3i,
        x: wp.array(dtype=vec3),
        v: wp.array(dtype=vec3),
        needed: wp.array2d(dtype=wp.int32),
        count: wp.array2d(dtype=wp.int64),
    ):
        p = wp.tid()
        copy = copy_of(p, needed.shape[1])
        within = p - copy * needed.shape[1]
        base = base_node(x[p], inv_dx)
        taken = 0
        if within < sample:
            taken = 1
            if not inside(base, wp.static(reach + 1), grid_shape):
                v[p] = vec3()  # no transfer will move it
        else:
            c = cell(base, lower, extent)
            if c >= 0 and stamps[copy, c] == step[copy]:
                taken = 1
            else:
                x[p] = vec3(real(-1.0), real(-1.0), real(-1.0))  # the grid starts at the origin
        needed[copy, within] = taken
        add_up(count, copy, taken)
        if within == 0:
            count[copy, 1] = count[copy, 1] + wp.int64(1)

    return stamp, select
