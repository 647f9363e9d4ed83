"""Kernels that give x and v where a reduced step needs them: at S, and at those of N that touch its nodes."""

from functools import cache

import warp as wp

from nsf.dynamics.modal_kernels import combination, make_tiles
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
# The displacement and its rate at one particle, by all lanes of a warp, or by a CPU's thread.
_AT_SAMPLE = """
    const int K = a.shape[1], Q = (K + 3) / 4;
    const double *const of_a = a.data + copy * K, *const of_rate = rate.data + copy * K;
    wp::vec_t<6, real> sum;
#if defined(__CUDA_ARCH__)
    const float4* first = (const float4*)modes.data + p;
    for (int q = lane; q < Q; q += 32) {
        #pragma unroll
        for (int c = 0; c < 3; ++c) {
            const float4 w = __ldg(first + size_t(c * Q + q) * particles);
            const float each[4] = {w.x, w.y, w.z, w.w};
            #pragma unroll
            for (int j = 0; j < 4; ++j) {
                if (4 * q + j >= K) break;
                sum[c] += real(each[j]) * real(of_a[4 * q + j]);
                sum[3 + c] += real(each[j]) * real(of_rate[4 * q + j]);
            }
        }
    }
    for (int d = 16; d > 0; d /= 2)
        for (int i = 0; i < 6; ++i) sum[i] += __shfl_xor_sync(0xffffffffu, sum[i], d);
#else
    for (int c = 0; c < 3; ++c) {
        const wp::float32* w = modes.data + (size_t(p) * 3 + c) * 4 * Q;
        for (int k = 0; k < K; ++k) {
            sum[c] += real(w[k]) * real(of_a[k]);
            sum[3 + c] += real(w[k]) * real(of_rate[k]);
        }
    }
#endif
    return sum;
"""


@wp.func
def _cell(base: wp.vec3i, lower: wp.vec3i, extent: wp.vec3i):
    """Flat index of a stencil's cell in a box that starts at `lower`, −1 outside it."""
    at = base - lower
    if not inside(at, 1, extent):
        return -1
    return (at[0] * extent[1] + at[1]) * extent[2] + at[2]


@cache
def make_sample(precision: Precision, shape_name: str, several: bool = False):
    """Kernel of x and v at S, `lanes` threads a particle, a warp or one.

    x = mean + Σ_k b_k a_k and v = Σ_k b_k ȧ_k, where ȧ is the backward difference of a (paper section 5.1:
    there is no v field); in the first step v is the initial velocity. It writes the number of the step to
    every cell from which a stencil meets one of S's; each simulation has cells of its own. A particle off
    the grid, which no transfer will move, gets no velocity.

    Source: paper section 5.4, a.
    """
    real, vec3 = precision.real, precision.vec3
    shape = shape_functions(precision, shape_name)
    base_node, reach = shape.base_node, shape.degree
    across = 2 * reach + 1
    sums = wp.types.vector(length=6, dtype=real)
    share, copy_of = make_copies(several)

    @wp.func_native(f"typedef {precision.native} real;{_AT_SAMPLE}")
    def combined(
        modes: wp.array(dtype=wp.float32),
        a: wp.array2d(dtype=wp.float64),
        rate: wp.array2d(dtype=wp.float64),
        particles: int,
        p: int,
        copy: int,
        lane: int,
    ) -> sums: ...

    @wp.kernel(enable_backward=False, module="unique", grid_stride=False)
    def sample(
        mean: wp.array(dtype=vec3),
        modes: wp.array(dtype=wp.float32),
        a: wp.array2d(dtype=wp.float64),
        rate: wp.array2d(dtype=wp.float64),
        initial_velocity: wp.array(dtype=vec3),
        first: wp.array(dtype=wp.int32),
        step: wp.array(dtype=wp.int32),
        stamps: wp.array2d(dtype=wp.int32),
        inv_dx: real,
        lower: wp.vec3i,
        extent: wp.vec3i,
        count: wp.array2d(dtype=wp.int64),
        x: wp.array(dtype=vec3),
        v: wp.array(dtype=vec3),
        grid_shape: wp.vec3i,
        of_sample: int,
        lanes: int,
    ):
        t, lane = wp.tid() / lanes, wp.tid() % lanes
        copy = copy_of(t, of_sample)
        p = t - copy * of_sample
        row = p + copy * share(x.shape[0], first.shape[0])
        moved = combined(modes, a, rate, of_sample, p, copy, lane)
        at = mean[p] + vec3(moved[0], moved[1], moved[2])
        base = base_node(at, inv_dx)
        if lane == 0:
            x[row] = at
            if not inside(base, wp.static(reach + 1), grid_shape):
                v[row] = vec3()
            elif first[copy] != 0:
                v[row] = initial_velocity[row]
            else:
                v[row] = vec3(moved[3], moved[4], moved[5])
            if p == 0:
                count[copy, 0] = count[copy, 0] + wp.int64(of_sample)
                count[copy, 1] = count[copy, 1] + wp.int64(1)
        offset = lane
        while offset < wp.static(across**3):
            place = wp.vec3i(offset / (across * across), (offset / across) % across, offset % across)
            c = _cell(base + place - wp.vec3i(reach, reach, reach), lower, extent)
            if c >= 0:
                stamps[copy, c] = step[copy]
            offset += lanes

    return sample


@cache
def make_others(
    precision: Precision,
    shape_name: str,
    vectors: int,
    tile: int = 1,
    several: bool = False,
    stored=wp.float32,
):
    """Kernel of x and v at N without S, as `make_sample`, one thread a particle and tile of simulations.

    It is launched over whole blocks; `several` tiles have blocks in turn. Only particles in the cells that
    `make_sample` has stamped are needed; it moves the rest off the grid, where the transfers pass over it.
    Which simulations of a tile need a particle are the bits of `needed`. `stored` is the type of the modes.

    Source: paper section 5.4, b.
    """
    real, vec3 = precision.real, precision.vec3
    base_node = shape_functions(precision, shape_name).base_node
    sums, places = wp.types.vector(length=6 * tile, dtype=real), wp.types.vector(length=tile, dtype=wp.int32)
    tile_of, within = make_tiles(several)
    snippet = f"""
    typedef {precision.native} real;
    const int Q = {vectors}, c = 0, components = 3;
    const bool live = p < particles;
    {combination("a rate", tile, several, stored is wp.float16)}
    """

    @wp.func_native(snippet)
    def combined(
        modes: wp.array(dtype=stored),
        lengths: wp.array(dtype=real),
        a: wp.array2d(dtype=wp.float64),
        rate: wp.array2d(dtype=wp.float64),
        particles: int,
        start: int,
        p: int,
    ) -> sums: ...

    @wp.func_native(_COUNT)
    def add_up(count: wp.array2d(dtype=wp.int64), copy: int, taken: int): ...

    @wp.kernel(enable_backward=False, module="unique", grid_stride=False)
    def others(
        mean: wp.array(dtype=vec3),
        modes: wp.array(dtype=stored),
        lengths: wp.array(dtype=real),
        a: wp.array2d(dtype=wp.float64),
        rate: wp.array2d(dtype=wp.float64),
        initial_velocity: wp.array(dtype=vec3),
        first: wp.array(dtype=wp.int32),
        step: wp.array(dtype=wp.int32),
        stamps: wp.array2d(dtype=wp.int32),
        inv_dx: real,
        lower: wp.vec3i,
        extent: wp.vec3i,
        count: wp.array2d(dtype=wp.int64),
        x: wp.array(dtype=vec3),
        v: wp.array(dtype=vec3),
        needed: wp.array2d(dtype=wp.int32),
        of_sample: int,
        tiles: int,
        lanes: int,
    ):
        t = within(wp.tid(), tiles, lanes)
        start = tile_of(wp.tid(), tiles, lanes) * wp.static(tile)
        n = mean.shape[0]
        moved = combined(modes, lengths, a, rate, n - of_sample, start, t)
        p = of_sample + t
        if p >= n:
            return
        taken, beginning = places(), places()
        # Before anything is written, so that all loads are under way together.
        for s in range(wp.static(tile)):
            copy = wp.min(start + s, first.shape[0] - 1)
            at = mean[p] + vec3(moved[6 * s], moved[6 * s + 1], moved[6 * s + 2])
            c = _cell(base_node(at, inv_dx), lower, extent)
            stamp = stamps[copy, wp.max(c, 0)]
            taken[s] = wp.where(c >= 0 and stamp == step[copy], 1, 0)
            beginning[s] = first[copy]
        bits = 0
        for s in range(wp.static(tile)):
            copy = start + s
            if copy < first.shape[0]:
                row = copy * n + p
                at = vec3(real(-1.0), real(-1.0), real(-1.0))  # the grid starts at the origin
                if taken[s] != 0:
                    bits += wp.static(1 << s)
                    at = mean[p] + vec3(moved[6 * s], moved[6 * s + 1], moved[6 * s + 2])
                    if beginning[s] != 0:
                        v[row] = initial_velocity[row]
                    else:
                        v[row] = vec3(moved[6 * s + 3], moved[6 * s + 4], moved[6 * s + 5])
                x[row] = at
                add_up(count, copy, taken[s])
        needed[start / wp.static(tile), p] = bits

    return others
