"""Kernels of a reduced step whose fields are modes times coefficients (`field=basis`).

Nothing here is read back to the host, and no launch depends on a value, so a step is one CUDA graph.
A few sums go over the threads of a block or of a warp by native code; on a CPU a block is one thread.
What each of several simulations has of its own lies simulation by simulation in the arrays; modes and weights
are common to all, and a thread reads them once for a tile of simulations.
"""

from functools import cache

import warp as wp

from nsf.mpm import Precision
from nsf.mpm.copies import make_copies
from nsf.mpm.grid import inside
from nsf.mpm.shape import shape_functions

THREADS = 128  # of a block that shares coefficients, or a sum over S
_AHEAD = 4  # vectors of modes whose loads are under way together
_TILE = 8  # most simulations of one thread: their sums fill its registers


#: Shared memory [byte] of a block without asking for more, and what Warp takes of it.
_SHARED, _TAKEN = 49152, 4096


def tiling(simulations: int, shared: int = 0) -> tuple[int, int]:
    """Tiles, and simulations of a tile, so that none is much emptier than the others.

    Args:
        simulations: in all.
        shared: memory [byte] that a block shares for each simulation of its tile.
    """
    most = max(1, min(_TILE, (_SHARED - _TAKEN) // max(shared, 1)))
    tiles = -(-simulations // most)
    return tiles, -(-simulations // tiles)


@cache
def _make_placing(several: bool):
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


def _combination(names: str, coefficient: str, tile: int, several: bool) -> str:
    """Native code of the sums Σ_k modes[p, c..c+2, k] name_k, for each simulation of a tile and each name.

    They are `sum`: three of the first name, three of the next, and so on for the next simulation; the first
    of the tile is `start`. The K modes lie in vectors of four, on a GPU those of neighbouring particles side
    by side (`Arena.modes`): what is under way then covers the time that memory takes, even for few particles.
    A GPU first takes the coefficients into shared memory, for which all threads of a block are needed, also
    those beyond the last particle; one that is not `live` only helps with that. A CPU may change the order of
    additions, so that it works on several at once.
    """
    load = "__ldg" if several else "__ldcs"  # another tile will read the same modes, or nothing will
    names = names.split()
    each, size = "".join, 3 * len(names)
    totals = [(n, i, f"sum[{size} * s + {3 * m + i}]") for m, n in enumerate(names) for i in range(3)]
    of_four = each(
        f"{total} += real(w{i}.{x}) * real(shared_{n}[s][4 * q + {j}]);"
        for j, x in enumerate("xyzw")
        for n, i, total in totals
    )
    zero = each(f"real {n}_{i} = 0;" for n, i, _ in totals)
    of_one = each(f"{n}_{i} += real(w{i}) * real({n}.data[(start + s) * K + k]);" for n, i, _ in totals)
    kept = each(f"{total} = {n}_{i};" for n, i, total in totals)
    shared = each(f"__shared__ {coefficient} shared_{n}[{tile}][4 * Q];" for n in names)
    filled = each(f"shared_{n}[s][k] = known ? {n}.data[(start + s) * K + k] : 0;" for n in names)
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
        const float4* first = (const float4*)modes.data + size_t(c) * Q * particles + p;
        #pragma unroll {_AHEAD}
        for (int q = 0; q < Q; ++q) {{
            const float4 w0 = {load}(first + size_t(q) * particles);
            const float4 w1 = {load}(first + size_t(Q + q) * particles);
            const float4 w2 = {load}(first + size_t(2 * Q + q) * particles);
            #pragma unroll
            for (int s = 0; s < {tile}; ++s) {{ {of_four} }}
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


def _scalar(precision: Precision) -> str:
    return {"fp32": "float", "fp64": "double"}[precision.name]


@cache
def make_position(precision: Precision, vectors: int, tile: int = 1, several: bool = False):
    """Kernel of x and v at N, one thread a particle and tile of simulations, launched over whole blocks.

    x = mean + Σ_k b_k a_k and v = Σ_k b_k ȧ_k, where ȧ is the backward difference of a (paper section 5.1:
    there is no v field); in the first step v is the initial velocity. `several` tiles have blocks in turn.
    """
    real, vec3 = precision.real, precision.vec3
    sums = wp.types.vector(length=6 * tile, dtype=real)
    tile_of, within = _make_placing(several)
    snippet = f"""
    typedef {_scalar(precision)} real;
    const int Q = {vectors}, c = 0, components = 3, particles = mean.shape[0];
    const bool live = p < particles;
    {_combination("a rate", "double", tile, several)}
    """

    @wp.func_native(snippet)
    def combined(
        modes: wp.array(dtype=wp.float32),
        a: wp.array2d(dtype=wp.float64),
        rate: wp.array2d(dtype=wp.float64),
        mean: wp.array(dtype=vec3),
        start: int,
        p: int,
    ) -> sums: ...

    @wp.kernel(enable_backward=False, module="unique", grid_stride=False)
    def position(
        mean: wp.array(dtype=vec3),
        modes: wp.array(dtype=wp.float32),
        a: wp.array2d(dtype=wp.float64),
        rate: wp.array2d(dtype=wp.float64),
        initial_velocity: wp.array(dtype=vec3),
        first: wp.array(dtype=wp.int32),
        tiles: int,
        lanes: int,
        x: wp.array(dtype=vec3),
        v: wp.array(dtype=vec3),
    ):
        p = within(wp.tid(), tiles, lanes)
        start = tile_of(wp.tid(), tiles, lanes) * wp.static(tile)
        moved = combined(modes, a, rate, mean, start, p)
        n = mean.shape[0]
        if p >= n:
            return
        for s in range(wp.static(tile)):
            if start + s < first.shape[0]:
                row = (start + s) * n + p
                x[row] = mean[p] + vec3(moved[6 * s], moved[6 * s + 1], moved[6 * s + 2])
                if first[start + s] != 0:
                    v[row] = initial_velocity[row]
                else:
                    v[row] = vec3(moved[6 * s + 3], moved[6 * s + 4], moved[6 * s + 5])

    return position


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


@cache
def make_contraction(
    precision: Precision, vectors: int, symmetric: bool, coefficients, tile: int = 1, several: bool = False
):
    """Kernel of a matrix field at N, mean + Σ_k modes_k a_k, over whole blocks.

    A thread has three components of a particle, in the simulations of a tile; `several` tiles have blocks in
    turn. The six components of a symmetric field are xx xy xz yy yz zz, the nine of another go row by row.
    Particles that are not needed are passed over. `coefficients` is the type of a.
    """
    real = precision.real
    sums = wp.types.vector(length=3 * tile, dtype=real)
    tile_of, within = _make_placing(several)
    scalar = {wp.float32: "float", wp.float64: "double"}[coefficients]
    snippet = f"""
    typedef {_scalar(precision)} real;
    const int Q = {vectors}, components = mean.shape[1], particles = mean.shape[0];
    {_combination("a", scalar, tile, several)}
    """

    @wp.func_native(snippet)
    def combined(
        modes: wp.array(dtype=wp.float32),
        mean: wp.array2d(dtype=real),
        a: wp.array2d(dtype=coefficients),
        start: int,
        p: int,
        c: int,
        live: bool,
    ) -> sums: ...

    @wp.kernel(enable_backward=False, module="unique", grid_stride=False)
    def contraction(
        needed: wp.array2d(dtype=wp.int32),
        mean: wp.array2d(dtype=real),
        modes: wp.array(dtype=wp.float32),
        a: wp.array2d(dtype=coefficients),
        tiles: int,
        lanes: int,
        found: wp.array3d(dtype=real),
    ):
        t = within(wp.tid(), tiles, lanes)
        start = tile_of(wp.tid(), tiles, lanes) * wp.static(tile)
        n = needed.shape[1]
        group, p = t / n, t % n
        c = 3 * group
        live = False
        if c < mean.shape[1]:
            for s in range(wp.static(tile)):
                if start + s < needed.shape[0] and needed[start + s, p] != 0:
                    live = True
        value = combined(modes, mean, a, start, p, c, live)
        if not live:
            return
        for s in range(wp.static(tile)):
            if start + s < needed.shape[0] and needed[start + s, p] != 0:
                row = (start + s) * n + p
                one = value[3 * s] + mean[p, c]
                two = value[3 * s + 1] + mean[p, c + 1]
                three = value[3 * s + 2] + mean[p, c + 2]
                if wp.static(not symmetric):
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

    return contraction


@cache
def make_layer(precision: Precision, tile: int = 1, several: bool = False):
    """Kernel of one layer of two networks at once: act(W x + b), W [out, in], x and b of each simulation.

    One warp has an output in the simulations of a tile. SiLU where `active`, else the identity; the second
    network's outputs follow the first's, `outputs` in all. Where W has fewer columns than x has entries, both
    are of several members, whose rows and entries follow each other.
    """
    real = precision.real
    sums = wp.types.vector(length=tile, dtype=real)
    _, copy_of = make_copies(several)
    snippet = f"""
    typedef {_scalar(precision)} real;
    const bool one = output < b_1.shape[1];
    const int o = one ? output : output - b_1.shape[1], outputs = one ? b_1.shape[1] : b_2.shape[1];
    const int n = one ? W_1.shape[1] : W_2.shape[1], entries = one ? x_1.shape[1] : x_2.shape[1];
    const int at = o / (outputs / (entries / n)) * n;  // where the entries of the output's member begin
    const real* row = (one ? W_1.data : W_2.data) + size_t(o) * n;
    const real *inputs[{tile}], *bias[{tile}];
    for (int s = 0; s < {tile}; ++s) {{
        const int simulation = wp::min(start + s, x_1.shape[0] - 1);  // one beyond the last is done again
        inputs[s] = (one ? x_1.data : x_2.data) + size_t(simulation) * entries + at;
        bias[s] = (one ? b_1.data : b_2.data) + size_t(simulation) * outputs + o;
    }}
    wp::vec_t<{tile}, real> sum;
    #pragma unroll 4
    for (int i = lane; i < n; i += lanes) {{
        const real w = row[i];
        #pragma unroll
        for (int s = 0; s < {tile}; ++s) sum[s] += w * inputs[s][i];
    }}
    #pragma unroll
    for (int s = 0; s < {tile}; ++s) {{
#if defined(__CUDA_ARCH__)
        for (int d = 16; d > 0; d /= 2) sum[s] += __shfl_xor_sync(0xffffffffu, sum[s], d);
#endif
        sum[s] += *bias[s];
    }}
    return sum;
    """

    @wp.func_native(snippet)
    def row(
        W_1: wp.array2d(dtype=real),
        b_1: wp.array2d(dtype=real),
        x_1: wp.array2d(dtype=real),
        W_2: wp.array2d(dtype=real),
        b_2: wp.array2d(dtype=real),
        x_2: wp.array2d(dtype=real),
        start: int,
        output: int,
        lane: int,
        lanes: int,
    ) -> sums: ...

    @wp.func
    def silu(z: real):
        return z / (real(1.0) + wp.exp(-z))

    @wp.kernel(enable_backward=False, module="unique", grid_stride=False)
    def layer(
        W_1: wp.array2d(dtype=real),
        b_1: wp.array2d(dtype=real),
        x_1: wp.array2d(dtype=real),
        W_2: wp.array2d(dtype=real),
        b_2: wp.array2d(dtype=real),
        x_2: wp.array2d(dtype=real),
        active: int,
        lanes: int,
        outputs: int,
        y_1: wp.array2d(dtype=real),
        y_2: wp.array2d(dtype=real),
    ):
        t = wp.tid()
        at = copy_of(t / lanes, outputs)
        o, lane = t / lanes - at * outputs, t % lanes
        start = at * wp.static(tile)
        first = b_1.shape[1]
        z = row(W_1, b_1, x_1, W_2, b_2, x_2, start, o, lane, lanes)
        if lane != 0:
            return
        for s in range(wp.static(tile)):
            if start + s < x_1.shape[0]:
                y = z[s]
                if active != 0:
                    y = silu(y)
                if o < first:
                    y_1[start + s, o] = y
                else:
                    y_2[start + s, o - first] = y

    return layer


@cache
def make_gathering(precision: Precision, several: bool = False):
    """Kernel of what the projection needs of S, one block a simulation and mode: b_k = Σ_p w_p B_p,kᵀ Δt v_p.

    The displacement of S in the step is Δt v_p, as its positions before it lie on the manifold. The last
    block of a simulation gives Σ_p w_p |Δt v_p|².
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
            const size_t next = size_t(vectors) * particles * 4;
            const wp::float32* at = displacement.data + (size_t(k / 4) * particles + p) * 4 + k % 4;
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
        particles: int,
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
        total = share(displacement, particles, vectors, sums - 1, v, weights, dt, start, k, lane, lanes)
        if lane == 0:
            b[copy, k] = total

    return gathering


def projection_block(widths: tuple[int, ...]) -> int:
    """Threads of the block that projects: enough to take the widest layer in one turn, if there may be."""
    widest = max((*widths[1:], 1))
    return min(1024, 32 * -(-(-(-widest // 2) * _PARTS) // 32))


#: Threads that share a sum over a layer's inputs; each has two outputs, to read its inputs once for both.
_PARTS = 8


def shared_bytes(precision: Precision, widths: tuple[int, ...], latents: int, modes: int) -> int:
    """Shared memory [byte] that the projection needs, without Bᵀw B."""
    widest, row = max((*widths[:-1], latents)), -(-latents // 4) * 4
    values = 2 * widest * precision.numpy().itemsize + 8 * widest * row
    return values + 8 * (5 * modes + 2 * modes * latents + 2 * latents * (latents + 2) + 4)


def projection_fits(precision: Precision, widths: tuple[int, ...], latents: int, modes: int) -> bool:
    """Whether one block of a GPU can hold what the projection needs."""
    return shared_bytes(precision, widths, latents, modes) <= _SHARED - _TAKEN


# Native code of the closure and its tangents, all layers in one piece: code that a step meets for the first
# time must be short. Values are summed in the precision of the step, tangents in fp32: they steer
# Gauss-Newton, and miss its fixed point by no more than their round-off times the residual.
_CLOSURE = """
        const int width[] = {widths};
        int offset = 0;
        #pragma unroll 1
        for (int n = 0; n < {layers} * {members}; ++n) {{
            const int l = n % {layers};
            const bool begun = n >= {layers};  // a member's share is there already
            if (l == 0) {{
                #pragma unroll 1
                for (int e = lane; e < R * R; e += lanes) {{
                    slope[0][e / R * ROW + e % R] = e / R == e % R ? 1.0f : 0.0f;
                    if (e < R) value[0][e] = real(x[e]);
                }}
                NSF_SYNC;
            }}
            const int in = width[l], out = width[l + 1], half = (out + 1) / 2, from = l % 2, to = 1 - from;
            const bool last = l == {layers} - 1;
            const slope_t* W = weights.data + offset;
            const slope_t* bias = W + in * out;
            offset += (in + 1) * out;
            #pragma unroll 1
            for (int e = lane; e < (half * PARTS + 31) / 32 * 32; e += lanes) {{
                const int part = e % PARTS, o = e / PARTS;
                const bool live = o < half, both = live && o + half < out;
                const slope_t* row_1 = W + (live ? o : 0) * in;
                const slope_t* row_2 = both ? row_1 + half * in : row_1;
                real v_1 = 0, v_2 = 0;
                slope_t u_1[R], u_2[R];
                for (int c = 0; c < R; ++c) u_1[c] = u_2[c] = 0.0f;
                #pragma unroll 1
                for (int start = part; start < in; start += PARTS * AHEAD) {{
                    slope_t w_1[AHEAD], w_2[AHEAD];
                    #pragma unroll
                    for (int j = 0; j < AHEAD; ++j) {{
                        const int i = start + j * PARTS;
                        w_1[j] = i < in ? row_1[i] : 0.0f;
                        w_2[j] = i < in ? row_2[i] : 0.0f;
                    }}
                    #pragma unroll
                    for (int j = 0; j < AHEAD; ++j) {{
                        const int i = start + j * PARTS;
                        if (i >= in) break;
                        const real h = value[from][i];
                        v_1 += real(w_1[j]) * h;
                        v_2 += real(w_2[j]) * h;
                        const slope_t* t = slope[from] + i * ROW;
                        for (int c = 0; c < R; ++c) {{
                            u_1[c] += w_1[j] * t[c];
                            u_2[c] += w_2[j] * t[c];
                        }}
                    }}
                }}
#if defined(__CUDA_ARCH__)
                #pragma unroll 1
                for (int d = PARTS / 2; d > 0; d /= 2) {{
                    v_1 += __shfl_xor_sync(0xffffffffu, v_1, d);
                    v_2 += __shfl_xor_sync(0xffffffffu, v_2, d);
                    for (int c = 0; c < R; ++c) {{
                        u_1[c] += __shfl_xor_sync(0xffffffffu, u_1[c], d);
                        u_2[c] += __shfl_xor_sync(0xffffffffu, u_2[c], d);
                    }}
                }}
#endif
                #pragma unroll 1
                for (int side = part; side < 2; side += PARTS) {{
                    if (side == 0 ? !live : !both) continue;
                    const int k = o + side * half;
                    const real z = (side == 0 ? v_1 : v_2) + real(bias[k]);
                    const real s = real(1) / (real(1) + exp(-z));
                    const slope_t rise = slope_t(s * (real(1) + z * (real(1) - s)));
                    if (last) at[R + k] = (begun ? at[R + k] : 0.0) + scale * z; else value[to][k] = z * s;
                    for (int c = 0; c < R; ++c) {{
                        const slope_t u = side == 0 ? u_1[c] : u_2[c];
                        if (last) {{
                            double& tangent = A[(R + k) * R + c];
                            tangent = (begun ? tangent : 0.0) + scale * u;
                        }} else slope[to][k * ROW + c] = rise * u;
                    }}
                }}
            }}
            NSF_SYNC;
        }}
"""


@cache
def make_projection(
    precision: Precision,
    widths: tuple[int, ...],
    members: int,
    latents: int,
    modes: int,
    several: bool = False,
):
    """Kernel of the inversion, one block a simulation: Gauss-Newton in the coefficients of the modes.

    With d = Δt v the displacement of S in the step and δa = a(x̂) − a(x̂_n), the error of the positions is
    d − B δa, so that all the projection takes from S is b = Bᵀw d, G = Bᵀw B and dᵀw d: an iteration does
    not depend on |S|. With A = ∂a/∂x̂ it solves (AᵀG A) u = Aᵀ(b − G δa), and the squared error is
    dᵀw d − δa·b − δa·(b − G δa).

    The coefficients are a = [σ x̂ ; closure(x̂)]; the closure is a network with SiLU between its layers, and
    its derivative goes forward with its value. Without iterations the kernel only evaluates a and A.

    Args:
        precision: of the closure; sums over modes and the solution are fp64.
        widths: of the closure's layers (r, hidden..., K − r); empty without one.
        members: networks of these widths whose shares in the closure are added up.
        latents: r.
        modes: K.

    Source: paper section 5.3.
    """
    real = precision.real
    _, copy_of = make_copies(several)
    widest = max((*widths[:-1], latents))
    kept = shared_bytes(precision, widths, latents, modes) + 8 * modes**2 <= _SHARED - _TAKEN
    closure = ""
    if widths:
        counts = "{" + ", ".join(map(str, widths)) + "}"
        closure = _CLOSURE.format(layers=len(widths) - 1, members=members, widths=counts)
    snippet = f"""
    typedef {_scalar(precision)} real;
    typedef float slope_t;  // as Warp takes float(x) for its own
#if defined(__CUDA_ARCH__)
    #define NSF_SHARED __shared__
    #define NSF_SYNC __syncthreads()
    const int lane = threadIdx.x, lanes = blockDim.x, PARTS = {_PARTS};
#else
    #define NSF_SHARED
    #define NSF_SYNC
    const int lane = 0, lanes = 1, PARTS = 1;
#endif
    const int R = {latents}, K = {modes}, C = R + 1;
    const int ROW = (R + 3) / 4 * 4;  // whole vectors of four
    const int AHEAD = {min(18, -(-widest // _PARTS))};  // weights whose loads are under way together
    NSF_SHARED real value[2][{widest}];
    NSF_SHARED alignas(16) slope_t slope[2][{widest} * ROW];
    NSF_SHARED double x[R], moved[K], at[K], a_n[K], d[K + 1], A[K * R], q[K], M[K * R], g[R], E[2][R * C];
    NSF_SHARED double error;
    NSF_SHARED int going;
    {"NSF_SHARED double gram[K * K];" if kept else "const double* gram = G.data;"}

    auto evaluate = [&]() {{
        #pragma unroll 1
        for (int e = lane; e < R * R; e += lanes) {{
            A[e] = e / R == e % R ? sigma.data[e / R] : 0.0;
            if (e < R) at[e] = sigma.data[e] * x[e];
        }}
        NSF_SYNC;
        {closure}
    }};
    // q = b - G da.
    auto residual = [&]() {{
        #pragma unroll 1
        for (int k = lane; k < K; k += lanes) moved[k] = at[k] - a_n[k];
        NSF_SYNC;
        #pragma unroll 1
        for (int k = lane; k < K; k += lanes) {{
            double sum = d[k];
            #pragma unroll 2
            for (int j = 0; j < K; ++j) sum -= gram[j * K + k] * moved[j];
            q[k] = sum;
        }}
        NSF_SYNC;
    }};
    // Where sums cancel to less than their round-off, nothing is left; a NaN stays one.
    auto least = [](double sum) {{ return sum < 0.0 ? 0.0 : sum; }};
    // The squared error, of which q is known.
    auto left = [&]() {{
        double sum = d[K];
        #pragma unroll 2
        for (int k = 0; k < K; ++k) sum -= moved[k] * (d[k] + q[k]);
        return least(sum);
    }};

    #pragma unroll 1
    for (int i = lane; i < R; i += lanes) x[i] = latent.data[i];
    #pragma unroll 1
    for (int k = lane; k < K; k += lanes) at[k] = a_n[k] = a.data[k];
    #pragma unroll 1
    for (int k = lane; k <= K; k += lanes) d[k] = b.data[k];
    #pragma unroll 1
    for (int e = lane; e < K * R; e += lanes) A[e] = tangents.data[e];
    {"for (int e = lane; e < K * K; e += lanes) gram[e] = G.data[e];" if kept else ""}
    if (lane == 0) going = 1;
    NSF_SYNC;
    const long long n = row.data[0];
    int done = 0;
    do {{
        if (iterations > 0) {{
            residual();
            #pragma unroll 1
            for (int e = lane; e < K * R; e += lanes) {{
                const int k = e / R, c = e % R;
                double sum = 0.0;
                #pragma unroll 2
                for (int j = 0; j < K; ++j) sum += gram[j * K + k] * A[j * R + c];
                M[e] = sum;
            }}
            if (lane == lanes - 1) error = left();
            NSF_SYNC;
            #pragma unroll 1
            for (int e = lane; e < R * C; e += lanes) {{
                const int c = e / C, other = e % C;
                double sum = 0.0;
                #pragma unroll 2
                for (int k = 0; k < K; ++k) sum += A[k * R + c] * (other < R ? M[k * R + other] : q[k]);
                E[0][e] = sum;
                if (other == R) g[c] = sum;
            }}
            NSF_SYNC;
            // Gauss and Jordan on [AᵀG A | Aᵀq]; it is positive definite, so that no pivot is sought.
            #pragma unroll 1
            for (int m = 0; m < R; ++m) {{
                const double* from = E[m % 2];
                #pragma unroll 1
                for (int e = lane; e < R * C; e += lanes) {{
                    const int i = e / C, c = e % C;
                    const double row = from[m * C + c] / from[m * C + m];
                    E[1 - m % 2][e] = i == m ? row : from[e] - from[i * C + m] * row;
                }}
                NSF_SYNC;
            }}
            if (lane == 0) {{
                double length = 0.0, change = 0.0;
                #pragma unroll 1
                for (int i = 0; i < R; ++i) {{
                    const double u = E[R % 2][i * C + R];
                    length += u * u;
                    change += u * g[i];
                    x[i] += u;
                }}
                length = sqrt(length);
                residuals.data[n * (iterations + 1) + done] = real(sqrt(error / sample));
                updates.data[n * iterations + done] = real(length);
                // What a linearised model leaves: |e - J u|² = |e|² - uᵀ(AᵀG A)u at the minimum.
                if (linear) error = least(error - change);
                going = !(length <= tolerance);
            }}
            NSF_SYNC;
        }}
        evaluate();
        ++done;
    }} while (going && done < iterations);
    if (iterations > 0) {{
        residual();
        if (lane == 0) {{
            if (!linear) error = left();
            for (int i = done; i <= iterations; ++i)
                residuals.data[n * (iterations + 1) + i] = real(sqrt(error / sample));
            for (int i = done; i < iterations; ++i) updates.data[n * iterations + i] = real(0);
            row.data[0] = n + 1;
            first.data[0] = 0;
            step.data[0] += 1;
        }}
    }}
    #pragma unroll 1
    for (int i = lane; i < R; i += lanes) {{
        if (iterations > 0) {{
            xhat_previous.data[i] = xhat.data[i];
            xhat.data[i] = real(x[i]);
            xhats.data[(n + 1) * R + i] = real(x[i]);
        }}
        latent.data[i] = x[i];
    }}
    #pragma unroll 1
    for (int k = lane; k < K; k += lanes) {{
        rate.data[k] = (at[k] - a_n[k]) / dt;
        a.data[k] = at[k];
    }}
    #pragma unroll 1
    for (int e = lane; e < K * R; e += lanes) tangents.data[e] = A[e];
    #undef NSF_SHARED
    #undef NSF_SYNC
    """

    @wp.func_native(snippet)
    def solve(
        weights: wp.array(dtype=wp.float32),
        scale: wp.float64,
        sigma: wp.array(dtype=wp.float64),
        G: wp.array(dtype=wp.float64),
        b: wp.array(dtype=wp.float64),
        sample: wp.float64,
        iterations: int,
        tolerance: wp.float64,
        linear: int,
        dt: wp.float64,
        latent: wp.array(dtype=wp.float64),
        a: wp.array(dtype=wp.float64),
        tangents: wp.array(dtype=wp.float64),
        rate: wp.array(dtype=wp.float64),
        xhat: wp.array(dtype=real),
        xhat_previous: wp.array(dtype=real),
        xhats: wp.array(dtype=real),
        residuals: wp.array(dtype=real),
        updates: wp.array(dtype=real),
        row: wp.array(dtype=wp.int64),
        first: wp.array(dtype=wp.int32),
        step: wp.array(dtype=wp.int32),
    ): ...

    @wp.kernel(
        enable_backward=False, module="unique", grid_stride=False, launch_bounds=projection_block(widths)
    )
    def projection(
        weights: wp.array(dtype=wp.float32),
        scale: wp.float64,
        sigma: wp.array(dtype=wp.float64),
        G: wp.array(dtype=wp.float64),
        b: wp.array2d(dtype=wp.float64),
        sample: wp.float64,
        iterations: int,
        tolerance: wp.float64,
        linear: int,
        dt: wp.float64,
        latent: wp.array2d(dtype=wp.float64),
        a: wp.array2d(dtype=wp.float64),
        tangents: wp.array2d(dtype=wp.float64),
        rate: wp.array2d(dtype=wp.float64),
        xhat: wp.array2d(dtype=real),
        xhat_previous: wp.array2d(dtype=real),
        xhats: wp.array2d(dtype=real),
        residuals: wp.array2d(dtype=real),
        updates: wp.array2d(dtype=real),
        row: wp.array2d(dtype=wp.int64),
        first: wp.array2d(dtype=wp.int32),
        step: wp.array2d(dtype=wp.int32),
        lanes: int,
    ):
        s = copy_of(wp.tid(), lanes)
        solve(
            weights, scale, sigma, G, b[s], sample, iterations, tolerance, linear, dt, latent[s], a[s],
            tangents[s], rate[s], xhat[s], xhat_previous[s], xhats[s], residuals[s], updates[s], row[s],
            first[s], step[s],
        )  # fmt: skip

    return projection
