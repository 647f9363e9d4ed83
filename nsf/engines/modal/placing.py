"""Kernels that write x and v at S, and at N, the particles that touch its nodes."""

from functools import cache

import warp as wp

from nsf.engines.modal.gathering import make_combination, make_tiles
from nsf.mpm import Precision
from nsf.mpm.batch import make_runs
from nsf.mpm.grid.nodes import inside
from nsf.mpm.grid.shape import shape_functions
from nsf.mpm.native import native_code


@wp.func
def _cell(base: wp.vec3i, lower: wp.vec3i, extent: wp.vec3i):
    """Flat index of a stencil's cell in a box that starts at `lower`, −1 outside it."""
    at = base - lower
    if not inside(at, 1, extent):
        return -1
    return (at[0] * extent[1] + at[1]) * extent[2] + at[2]


@cache
def _make_motion(precision: Precision):
    """Warp struct of what tells where particles are, and of what is found.

    The coefficients a and their rate are of each run, as are whether its step is the `first`, the
    number of the `step`, the `stamps` of cells, and `count`: particles of N in all steps, and the steps.
    `mean` and the box of cells, which begins at `lower`, are common to all. x, v and the initial velocity
    have a row for each particle of each run, the `of_sample` of S first.
    """
    real, vec3 = precision.real, precision.vec3

    @wp.struct
    class Motion:
        mean: wp.array(dtype=vec3)
        a: wp.array2d(dtype=wp.float64)
        rate: wp.array2d(dtype=wp.float64)
        initial_velocity: wp.array(dtype=vec3)
        first: wp.array(dtype=wp.int32)
        step: wp.array(dtype=wp.int32)
        stamps: wp.array2d(dtype=wp.int32)
        inv_dx: real
        lower: wp.vec3i
        extent: wp.vec3i
        count: wp.array2d(dtype=wp.int64)
        x: wp.array(dtype=vec3)
        v: wp.array(dtype=vec3)
        of_sample: int

    return Motion


@cache
def make_sample(precision: Precision, shape_name: str, several: bool = False):
    """Kernel of x and v at S, `lanes` threads a particle, a warp or one.

    x = mean + Σ_k b_k a_k and v = Σ_k b_k ȧ_k, where ȧ is the backward difference of a (paper section 5.1:
    there is no v field); in the first step v is the initial velocity. It writes the number of the step to
    every cell from which a stencil meets one of S's; each run has cells of its own. A particle off
    the grid, which no transfer will move, gets no velocity.

    Source: paper section 5.4, a.
    """
    real, vec3 = precision.real, precision.vec3
    shape = shape_functions(precision, shape_name)
    base_node, reach = shape.base_node, shape.degree
    across = 2 * reach + 1
    sums = wp.types.vector(length=6, dtype=real)
    share, run_of = make_runs(several)
    Motion = _make_motion(precision)

    @wp.func_native(native_code(__package__, "sample", real=precision.native))
    def combined(motion: Motion, modes: wp.array(dtype=wp.float32), p: int, run: int, lane: int) -> sums: ...

    @wp.kernel(enable_backward=False, module="unique", grid_stride=False)
    def sample(at: Motion, modes: wp.array(dtype=wp.float32), grid_shape: wp.vec3i, lanes: int):
        t, lane = wp.tid() / lanes, wp.tid() % lanes
        run = run_of(t, at.of_sample)
        p = t - run * at.of_sample
        row = p + run * share(at.x.shape[0], at.first.shape[0])
        moved = combined(at, modes, p, run, lane)
        x = at.mean[p] + vec3(moved[0], moved[1], moved[2])
        base = base_node(x, at.inv_dx)
        if lane == 0:
            at.x[row] = x
            if not inside(base, wp.static(reach + 1), grid_shape):
                at.v[row] = vec3()
            elif at.first[run] != 0:
                at.v[row] = at.initial_velocity[row]
            else:
                at.v[row] = vec3(moved[3], moved[4], moved[5])
            if p == 0:
                at.count[run, 0] = at.count[run, 0] + wp.int64(at.of_sample)
                at.count[run, 1] = at.count[run, 1] + wp.int64(1)
        offset = lane
        while offset < wp.static(across**3):
            place = wp.vec3i(offset / (across * across), (offset / across) % across, offset % across)
            c = _cell(base + place - wp.vec3i(reach, reach, reach), at.lower, at.extent)
            if c >= 0:
                at.stamps[run, c] = at.step[run]
            offset += lanes

    return sample


@cache
def make_neighbours(
    precision: Precision,
    shape_name: str,
    vectors: int,
    tile: int = 1,
    several: bool = False,
    stored=wp.float32,
):
    """Kernel of x and v at N without S, as `make_sample`, one thread a particle and tile of runs.

    It is launched over whole blocks; `several` tiles have blocks in turn. Only particles in the cells that
    `make_sample` has stamped are of N; it moves all others off the grid, where the transfers pass over them.
    Which runs of a tile need a particle are the bits of `in_N`. `stored` is the type of the modes.

    Source: paper section 5.4, b.
    """
    real, vec3 = precision.real, precision.vec3
    base_node = shape_functions(precision, shape_name).base_node
    places = wp.types.vector(length=tile, dtype=wp.int32)
    tile_of, within = make_tiles(several)
    Motion = _make_motion(precision)
    combined = make_combination(precision, vectors, 2, tile, several, wp.float64, stored)

    @wp.func_native(native_code(__package__, "count"))
    def add_up(count: wp.array2d(dtype=wp.int64), run: int, needs: int): ...

    @wp.kernel(enable_backward=False, module="unique", grid_stride=False)
    def neighbours(
        at: Motion,
        modes: wp.array(dtype=stored),
        lengths: wp.array(dtype=real),
        rows: wp.array(dtype=wp.int32),
        in_N: wp.array2d(dtype=wp.int32),
        tiles: int,
        lanes: int,
    ):
        t = within(wp.tid(), tiles, lanes)
        start = tile_of(wp.tid(), tiles, lanes) * wp.static(tile)
        n, of_sample = at.mean.shape[0], at.of_sample
        live = t < n - of_sample
        moved = combined(modes, lengths, rows, at.a, at.rate, n - of_sample, 3, start, t, 0, live)
        if not live:
            return
        p = of_sample + t
        mean, needs, beginning = at.mean[p], places(), places()
        # Before anything is written, so that all loads are under way together.
        for s in range(wp.static(tile)):
            run = wp.min(start + s, at.first.shape[0] - 1)
            x = mean + vec3(moved[6 * s], moved[6 * s + 1], moved[6 * s + 2])
            c = _cell(base_node(x, at.inv_dx), at.lower, at.extent)
            stamp = at.stamps[run, wp.max(c, 0)]
            needs[s] = wp.where(c >= 0 and stamp == at.step[run], 1, 0)
            beginning[s] = at.first[run]
        bits = 0
        for s in range(wp.static(tile)):
            run = start + s
            if run < at.first.shape[0]:
                row = run * n + p
                x = vec3(real(-1.0), real(-1.0), real(-1.0))  # the grid starts at the origin
                if needs[s] != 0:
                    bits += wp.static(1 << s)
                    x = mean + vec3(moved[6 * s], moved[6 * s + 1], moved[6 * s + 2])
                    if beginning[s] != 0:
                        at.v[row] = at.initial_velocity[row]
                    else:
                        at.v[row] = vec3(moved[6 * s + 3], moved[6 * s + 4], moved[6 * s + 5])
                at.x[row] = x
                add_up(at.count, run, needs[s])
        in_N[start / wp.static(tile), p] = bits

    return neighbours
