"""Kernel of the networks that a reduced step evaluates once, not at every particle (`field=basis`)."""

from collections.abc import Sequence
from functools import cache

import warp as wp

from nsf.mpm import Precision
from nsf.mpm.copies import make_copies

_AHEAD = 9  # weights of a GPU's thread whose loads are under way together: all of 288 inputs
_EDGE, _DEEP = 16, 128  # outputs, as many simulations, and inputs that a block of a product holds at once


@cache
def make_layer(precision: Precision, tile: int = 1, several: bool = False, latents: int = 0):
    """Kernel of one layer of two networks at once: act(W x + b), W [out, in], x and b of each simulation.

    One warp has an output in the simulations of a tile. SiLU where `active`, else the identity; the second
    network's outputs follow the first's, `outputs` in all. Where W has fewer columns than there are entries,
    both are of several members, whose rows and entries follow each other. With `latents`, x is what the layer
    before takes, of so many entries: silu(W_0 x + b_0), which every warp finds anew, as a launch costs more.
    """
    real = precision.real
    sums = wp.types.vector(length=tile, dtype=real)
    _, copy_of = make_copies(several)
    before = f"""
        const real* first = (one ? W_01.data : W_02.data) + size_t(at + i) * {latents};
        real z = (one ? b_01.data : b_02.data)[size_t(of(s)) * entries + at + i];
        for (int c = 0; c < {latents}; ++c) z += first[c] * x[of(s) * {latents} + c];
        return z / (real(1) + exp(-z));
    """
    entries = "W_0{}.shape[0]" if latents else "x_{}.shape[1]"
    snippet = f"""
    typedef {precision.native} real;
    const bool one = output < b_1.shape[1];
    const int o = one ? output : output - b_1.shape[1], outputs = one ? b_1.shape[1] : b_2.shape[1];
    const int n = one ? W_1.shape[1] : W_2.shape[1];
    const real* x = one ? x_1.data : x_2.data;
    const int entries = one ? {entries.format(1)} : {entries.format(2)};
    const int at = o / (outputs / (entries / n)) * n;  // where the entries of the output's member begin
    const real* row = (one ? W_1.data : W_2.data) + size_t(o) * n;
    // One beyond the last simulation is done again.
    auto of = [&](int s) {{ return wp::min(start + s, x_1.shape[0] - 1); }};
    auto entry = [&](int s, int i) {{
        {before if latents else "return x[size_t(of(s)) * entries + at + i];"}
    }};
    wp::vec_t<{tile}, real> sum;
    real bias[{tile}];
    for (int s = 0; s < {tile}; ++s) bias[s] = (one ? b_1.data : b_2.data)[size_t(of(s)) * outputs + o];
#if defined(__CUDA_ARCH__)
    #pragma unroll 1
    for (int begin = lane; begin < n; begin += {_AHEAD} * lanes) {{
        real w[{_AHEAD}];
        #pragma unroll
        for (int j = 0; j < {_AHEAD}; ++j) w[j] = begin + j * lanes < n ? row[begin + j * lanes] : real(0);
        #pragma unroll
        for (int j = 0; j < {_AHEAD}; ++j) {{
            const int i = wp::min(begin + j * lanes, n - 1);
            #pragma unroll
            for (int s = 0; s < {tile}; ++s) sum[s] += w[j] * entry(s, i);
        }}
    }}
#else
    for (int i = 0; i < n; ++i)
        for (int s = 0; s < {tile}; ++s) sum[s] += row[i] * entry(s, i);
#endif
    #pragma unroll
    for (int s = 0; s < {tile}; ++s) {{
#if defined(__CUDA_ARCH__)
        for (int d = 16; d > 0; d /= 2) sum[s] += __shfl_xor_sync(0xffffffffu, sum[s], d);
#endif
        sum[s] += bias[s];
    }}
    return sum;
    """

    @wp.func_native(snippet)
    def row(
        W_01: wp.array2d(dtype=real),
        b_01: wp.array2d(dtype=real),
        W_1: wp.array2d(dtype=real),
        b_1: wp.array2d(dtype=real),
        x_1: wp.array2d(dtype=real),
        W_02: wp.array2d(dtype=real),
        b_02: wp.array2d(dtype=real),
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
        W_01: wp.array2d(dtype=real),
        b_01: wp.array2d(dtype=real),
        W_1: wp.array2d(dtype=real),
        b_1: wp.array2d(dtype=real),
        x_1: wp.array2d(dtype=real),
        W_02: wp.array2d(dtype=real),
        b_02: wp.array2d(dtype=real),
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
        z = row(W_01, b_01, W_1, b_1, x_1, W_02, b_02, W_2, b_2, x_2, start, o, lane, lanes)
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


def product_blocks(sides: Sequence[tuple[int, int]], simulations: int) -> tuple[int, int]:
    """Blocks of `make_product` of the first network for a tile of simulations, and of all for all of them.

    Args:
        sides: (outputs, members) of each network.
        simulations: of the batch.
    """
    each = [members * -(-outputs // members // _EDGE) for outputs, members in sides]
    return each[0], sum(each) * -(-simulations // _EDGE)


@cache
def make_product(precision: Precision):
    """Kernel of a layer as `make_layer`'s for many simulations on a GPU, over `blocks` of 128 threads.

    A block has 16 outputs of a member in each of 16 simulations; its four warps share the inputs, and add up.
    The blocks of a tile of simulations follow each other, the `first` of them are of the first network.
    """
    real = precision.real
    snippet = f"""
    typedef {precision.native} real;
    const int EDGE = {_EDGE}, DEEP = {_DEEP}, T = threadIdx.x, lane = T % 32, warp = T / 32;
    __shared__ real w[DEEP][EDGE + 1], h[DEEP][EDGE + 1];
    const int simulations = x_1.shape[0], each = blocks / ((simulations + EDGE - 1) / EDGE);
    const int block = blockIdx.x % each, start = blockIdx.x / each * EDGE;
    const bool one = block < first;
    const int n = one ? W_1.shape[1] : W_2.shape[1], outputs = one ? b_1.shape[1] : b_2.shape[1];
    const int entries = one ? x_1.shape[1] : x_2.shape[1];
    const int own = outputs / (entries / n), chunks = (own + EDGE - 1) / EDGE;  // of a member
    const int member = (one ? block : block - first) / chunks;
    const int from = (one ? block : block - first) % chunks * EDGE;
    const real* W = (one ? W_1.data : W_2.data) + size_t(member) * own * n;
    const real* x = (one ? x_1.data : x_2.data) + size_t(member) * n;
    // An output or a simulation beyond the last one is that one again, and not written.
    real sum[4][2] = {{}};
    for (int begin = 0; begin < n; begin += DEEP) {{
        const int i = begin + T;
        #pragma unroll
        for (int j = 0; j < EDGE; ++j) {{
            w[T][j] = i < n ? W[size_t(wp::min(from + j, own - 1)) * n + i] : real(0);
            h[T][j] = i < n ? x[size_t(wp::min(start + j, simulations - 1)) * entries + i] : real(0);
        }}
        __syncthreads();
        const int end = wp::min(n - begin, 32 * warp + 32);
        #pragma unroll 4
        for (int k = 32 * warp; k < end; ++k)
            for (int u = 0; u < 4; ++u)
                for (int v = 0; v < 2; ++v) sum[u][v] += w[k][lane % 4 + 4 * u] * h[k][lane / 4 + 8 * v];
        __syncthreads();
    }}
    real(*share)[EDGE * EDGE] = (real(*)[EDGE * EDGE])w;
    for (int u = 0; u < 4; ++u)
        for (int v = 0; v < 2; ++v) share[warp][(lane / 4 + 8 * v) * EDGE + lane % 4 + 4 * u] = sum[u][v];
    __syncthreads();
    for (int e = T; e < EDGE * EDGE; e += blockDim.x) {{
        const int s = start + e / EDGE, o = from + e % EDGE;
        if (s >= simulations || o >= own) continue;
        const size_t at = size_t(s) * outputs + member * own + o;
        real z = (one ? b_1.data : b_2.data)[at];
        for (int j = 0; j < 4; ++j) z += share[j][e];
        (one ? y_1.data : y_2.data)[at] = active ? z / (real(1) + exp(-z)) : z;
    }}
    """

    @wp.func_native(snippet)
    def multiply(
        W_1: wp.array2d(dtype=real),
        b_1: wp.array2d(dtype=real),
        x_1: wp.array2d(dtype=real),
        W_2: wp.array2d(dtype=real),
        b_2: wp.array2d(dtype=real),
        x_2: wp.array2d(dtype=real),
        active: int,
        first: int,
        blocks: int,
        y_1: wp.array2d(dtype=real),
        y_2: wp.array2d(dtype=real),
    ): ...

    @wp.kernel(enable_backward=False, module="unique", grid_stride=False)
    def product(
        W_1: wp.array2d(dtype=real),
        b_1: wp.array2d(dtype=real),
        x_1: wp.array2d(dtype=real),
        W_2: wp.array2d(dtype=real),
        b_2: wp.array2d(dtype=real),
        x_2: wp.array2d(dtype=real),
        active: int,
        first: int,
        blocks: int,
        y_1: wp.array2d(dtype=real),
        y_2: wp.array2d(dtype=real),
    ):
        multiply(W_1, b_1, x_1, W_2, b_2, x_2, active, first, blocks, y_1, y_2)

    return product
