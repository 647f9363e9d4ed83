"""Kernel of the networks that a reduced step evaluates once, not at every particle (`field=basis`)."""

from functools import cache

import warp as wp

from nsf.mpm import Precision
from nsf.mpm.copies import make_copies

_AHEAD = 9  # weights of a GPU's thread whose loads are under way together


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
