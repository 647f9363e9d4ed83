"""Kernels of a reduced step whose fields are modes times coefficients (`field=basis`).

Nothing here is read back to the host, and no launch depends on a value, so a step is one CUDA graph.
A few sums go over the threads of a block or of a warp by native code; on a CPU a block is one thread.
What each of several simulations has of its own lies simulation by simulation in the arrays; modes and weights
are common to all, and a thread reads them once for a tile of simulations.
"""

from functools import cache

import warp as wp

from nsf.mpm import Precision
from nsf.mpm.access import SHARED, TAKEN
from nsf.mpm.copies import make_copies

THREADS = 128  # of a block that shares coefficients, or a sum over S
_AHEAD = 4  # vectors of modes whose loads are under way together
_TILE = 8  # most simulations of one thread: their sums fill its registers


def tiling(simulations: int, shared: int = 0) -> tuple[int, int]:
    """Tiles, and simulations of a tile, so that none is much emptier than the others.

    Args:
        simulations: in all.
        shared: memory [byte] that a block shares for each simulation of its tile.
    """
    most = max(1, min(_TILE, (SHARED - TAKEN) // max(shared, 1)))
    tiles = -(-simulations // most)
    return tiles, -(-simulations // tiles)


@cache
def make_tiles(several: bool):
    """Warp functions (thread, tiles, lanes) → its tile, and its number among the threads of that tile.

    Blocks of `lanes` threads are of one tile; those of the tiles follow each other, so that they find in a
    cache the modes of the same particles.
    """
    if several:

        @wp.func
        def tile_of(thread: int, tiles: int, lanes: int):
            return thread / lanes % tiles

        @wp.func
        def within(thread: int, tiles: int, lanes: int):
            return thread / (lanes * tiles) * lanes + thread % lanes

    else:

        @wp.func
        def tile_of(thread: int, tiles: int, lanes: int):
            return 0

        @wp.func
        def within(thread: int, tiles: int, lanes: int):
            return thread

    return tile_of, within


# Four numbers in half precision → float4.
_WIDENED = """
        auto widened = [](const uint2 four) {
            float4 w;
            asm("{.reg .f16 a, b; mov.b32 {a, b}, %2; cvt.f32.f16 %0, a; cvt.f32.f16 %1, b;}"
                : "=f"(w.x), "=f"(w.y) : "r"(four.x));
            asm("{.reg .f16 a, b; mov.b32 {a, b}, %2; cvt.f32.f16 %0, a; cvt.f32.f16 %1, b;}"
                : "=f"(w.z), "=f"(w.w) : "r"(four.y));
            return w;
        };
"""


def combination(names: str, tile: int, several: bool, half: bool = False) -> str:
    """Native code of the sums Σ_k modes[p, c..c+2, k] name_k, for each simulation of a tile and each name.

    They are `sum`: three of the first name, three of the next, and so on for the next simulation; the first
    of the tile is `start`. The K modes lie in vectors of four, on a GPU those of neighbouring particles side
    by side (`Arena.modes`): what is under way then covers the time that memory takes, even for few particles.
    A GPU first takes the coefficients into shared memory, for which all threads of a block are needed, also
    those beyond the last particle; one that is not `live` only helps with that. A CPU may change the order of
    additions, so that it works on several at once. `half`: a GPU has the modes in half precision, each over
    its length (`Arena.halved`).
    """
    load = "__ldcg" if several else "__ldcs"  # another tile will read the same modes, or nothing will
    widened, stored, ahead = ("widened", "uint2", 2 * _AHEAD) if half else ("", "float4", _AHEAD)
    names = names.split()
    each, size = "".join, 3 * len(names)
    totals = [(n, i, f"sum[{size} * s + {3 * m + i}]") for m, n in enumerate(names) for i in range(3)]
    of_four = each(
        f"{total} += real(w{i}.{x}) * shared_{n}[s][4 * q + {j}];"
        for j, x in enumerate("xyzw")
        for n, i, total in totals
    )
    zero = each(f"real {n}_{i} = 0;" for n, i, _ in totals)
    of_one = each(f"{n}_{i} += real(w{i}) * real({n}.data[(start + s) * K + k]);" for n, i, _ in totals)
    kept = each(f"{total} = {n}_{i};" for n, i, total in totals)
    shared = each(f"__shared__ real shared_{n}[{tile}][4 * Q];" for n in names)
    length = " * lengths.data[k]" if half else ""
    filled = each(
        f"shared_{n}[s][k] = known ? real({n}.data[(start + s) * K + k]{length}) : real(0);" for n in names
    )
    return f"""
    const int K = {names[0]}.shape[1], simulations = {names[0]}.shape[0];
    wp::vec_t<{size * tile}, real> sum;
#if defined(__CUDA_ARCH__)
    {shared}
    for (int e = threadIdx.x; e < {tile} * 4 * Q; e += blockDim.x) {{
        const int s = e / (4 * Q), k = e % (4 * Q);
        const bool known = k < K && start + s < simulations;
        {filled}
    }}
    __syncthreads();
    if (live) {{
        {_WIDENED if half else ""}
        const {stored}* first = (const {stored}*)modes.data + size_t(c) * Q * particles + p;
        const int ahead = {ahead};
        #pragma unroll 1
        for (int begin = 0; begin < Q; begin += ahead) {{
            {stored} under_way[ahead][3];
            #pragma unroll
            for (int j = 0; j < ahead; ++j)
                for (int i = 0; i < 3; ++i)
                    if (begin + j < Q)
                        under_way[j][i] = {load}(first + size_t(i * Q + begin + j) * particles);
            // Else the compiler puts each load beside its use, which is of no harm in fp64.
            if (sizeof(real) == 4) __syncwarp(__activemask());
            #pragma unroll
            for (int j = 0; j < ahead; ++j) {{
                const int q = begin + j;
                if (q >= Q) break;
                const float4 w0 = {widened}(under_way[j][0]), w1 = {widened}(under_way[j][1]);
                const float4 w2 = {widened}(under_way[j][2]);
                #pragma unroll
                for (int s = 0; s < {tile}; ++s) {{ {of_four} }}
            }}
        }}
    }}
#else
    if (live) {{
        #pragma clang fp reassociate(on)
        const wp::float32* first = modes.data + (size_t(p) * components + c) * 4 * Q;
        for (int s = 0; s < {tile} && start + s < simulations; ++s) {{
            {zero}
            for (int k = 0; k < K; ++k) {{
                const wp::float32 w0 = first[k], w1 = first[4 * Q + k], w2 = first[8 * Q + k];
                {of_one}
            }}
            {kept}
        }}
    }}
#endif
    return sum;
"""


@cache
def _make_field(precision: Precision, vectors: int, coefficients, tile: int, several: bool, stored):
    """Warp function of `make_contraction` for one of its fields; t is a thread's number in the field."""
    real, vec3, half = precision.real, precision.vec3, stored is wp.float16
    sums = wp.types.vector(length=3 * tile, dtype=real)
    snippet = f"""
    typedef {precision.native} real;
    const int Q = {vectors}, components = mean.shape[1], particles = mean.shape[0];
    {combination("a", tile, several, half)}
    """

    @wp.func_native(snippet)
    def combined(
        modes: wp.array(dtype=stored),
        lengths: wp.array(dtype=real),
        mean: wp.array2d(dtype=real),
        a: wp.array2d(dtype=coefficients),
        start: int,
        p: int,
        c: int,
        live: bool,
    ) -> sums: ...

    @wp.func
    def field(
        needed: wp.array2d(dtype=wp.int32),
        mean: wp.array2d(dtype=real),
        modes: wp.array(dtype=stored),
        lengths: wp.array(dtype=real),
        a: wp.array2d(dtype=coefficients),
        found: wp.array3d(dtype=real),
        start: int,
        t: int,
    ):
        n = needed.shape[1]
        groups = mean.shape[1] / 3
        if wp.static(several):  # what a warp stores then lies together, which gains more than its loads lose
            group, p = t % groups, t / groups
        else:
            group, p = t / n, t % n
        c = 3 * group
        bits = 0
        if c < mean.shape[1] and p < n:
            bits = needed[start / wp.static(tile), p]
        live = bits != 0
        middle = vec3()
        if live:  # loaded before all that is waited for below
            middle = vec3(mean[p, c], mean[p, c + 1], mean[p, c + 2])
        value = combined(modes, lengths, mean, a, start, p, c, live)
        if not live:
            return
        for s in range(wp.static(tile)):
            if (bits & wp.static(1 << s)) != 0:
                row = (start + s) * n + p
                one = value[3 * s] + middle[0]
                two = value[3 * s + 1] + middle[1]
                three = value[3 * s + 2] + middle[2]
                if mean.shape[1] == 9:
                    found[row, group, 0] = one
                    found[row, group, 1] = two
                    found[row, group, 2] = three
                elif group == 0:
                    found[row, 0, 0] = one
                    found[row, 0, 1] = two
                    found[row, 1, 0] = two
                    found[row, 0, 2] = three
                    found[row, 2, 0] = three
                else:
                    found[row, 1, 1] = one
                    found[row, 1, 2] = two
                    found[row, 2, 1] = two
                    found[row, 2, 2] = three

    return field


@cache
def make_contraction(
    precision: Precision,
    vectors: tuple[int, int],
    coefficients,
    tile: int = 1,
    several: bool = False,
    stored=wp.float32,
):
    """Kernel of two matrix fields at N at once, each mean + Σ_k modes_k a_k, over whole blocks.

    A thread has three components of a particle, in the simulations of a tile; `several` tiles have blocks in
    turn. The first `threads` are those of the first field. The six components of a symmetric field are xx xy
    xz yy yz zz, the nine of another go row by row. Nothing is found where the bit of a simulation in `needed`
    is not set, see `make_others`. `vectors` are those of four modes of either field, `coefficients` is the
    type of a, `stored` that of modes.
    """
    real = precision.real
    tile_of, within = make_tiles(several)
    first, second = (_make_field(precision, Q, coefficients, tile, several, stored) for Q in vectors)

    @wp.kernel(enable_backward=False, module="unique", grid_stride=False)
    def contraction(
        needed: wp.array2d(dtype=wp.int32),
        mean_1: wp.array2d(dtype=real),
        modes_1: wp.array(dtype=stored),
        lengths_1: wp.array(dtype=real),
        a_1: wp.array2d(dtype=coefficients),
        found_1: wp.array3d(dtype=real),
        mean_2: wp.array2d(dtype=real),
        modes_2: wp.array(dtype=stored),
        lengths_2: wp.array(dtype=real),
        a_2: wp.array2d(dtype=coefficients),
        found_2: wp.array3d(dtype=real),
        threads: int,
        tiles: int,
        lanes: int,
    ):
        t = within(wp.tid(), tiles, lanes)
        start = tile_of(wp.tid(), tiles, lanes) * wp.static(tile)
        if t < threads:  # whole blocks
            first(needed, mean_1, modes_1, lengths_1, a_1, found_1, start, t)
        else:
            second(needed, mean_2, modes_2, lengths_2, a_2, found_2, start, t - threads)

    return contraction


@cache
def make_gathering(precision: Precision, several: bool = False):
    """Kernel of what the projection needs of S, one block a simulation and mode: b_k = Σ_p w_p B_p,kᵀ Δt v_p.

    The displacement of S in the step is Δt v_p, as its positions before it lie on the manifold. The last
    block of a simulation gives Σ_p w_p |Δt v_p|². `displacement` holds the modes of S alone; v has rows of
    `particles` of each simulation, S first.
    """
    vec3 = precision.vec3
    _, copy_of = make_copies(several)
    snippet = """
    double sum = 0.0;
    #pragma unroll 4
    for (int p = lane; p < weights.shape[0]; p += lanes) {
        const double x = double(v.data[start + p][0]);
        const double y = double(v.data[start + p][1]), z = double(v.data[start + p][2]);
        double one = dt * x, two = dt * y, three = dt * z;
        if (k < modes) {
#if defined(__CUDA_ARCH__)
            const size_t next = size_t(vectors) * weights.shape[0] * 4;
            const wp::float32* at = displacement.data + (size_t(k / 4) * weights.shape[0] + p) * 4 + k % 4;
#else
            const size_t next = 4 * vectors;
            const wp::float32* at = displacement.data + size_t(p) * 3 * next + k;
#endif
            one = at[0];
            two = at[next];
            three = at[2 * next];
        }
        sum += weights.data[p] * (one * x + two * y + three * z);
    }
    sum *= dt;
#if defined(__CUDA_ARCH__)
    __shared__ double partial[32];
    for (int d = 16; d > 0; d /= 2) sum += __shfl_xor_sync(0xffffffffu, sum, d);
    if (threadIdx.x % 32 == 0) partial[threadIdx.x / 32] = sum;
    __syncthreads();
    sum = 0.0;
    for (int w = 0; w < blockDim.x / 32; ++w) sum += partial[w];
#endif
    return sum;
    """

    @wp.func_native(snippet)
    def share(
        displacement: wp.array(dtype=wp.float32),
        vectors: int,
        modes: int,
        v: wp.array(dtype=vec3),
        weights: wp.array(dtype=wp.float64),
        dt: wp.float64,
        start: int,
        k: int,
        lane: int,
        lanes: int,
    ) -> wp.float64: ...

    @wp.kernel(enable_backward=False, module="unique", grid_stride=False)
    def gathering(
        displacement: wp.array(dtype=wp.float32),
        particles: int,
        vectors: int,
        v: wp.array(dtype=vec3),
        weights: wp.array(dtype=wp.float64),
        dt: wp.float64,
        lanes: int,
        b: wp.array2d(dtype=wp.float64),
    ):
        t = wp.tid()
        sums = b.shape[1]
        copy = copy_of(t / lanes, sums)
        k, lane = t / lanes - copy * sums, t % lanes
        start = copy * particles
        total = share(displacement, vectors, sums - 1, v, weights, dt, start, k, lane, lanes)
        if lane == 0:
            b[copy, k] = total

    return gathering
