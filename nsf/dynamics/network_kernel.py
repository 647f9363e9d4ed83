"""Kernel of the networks that a reduced step evaluates once, not at every particle (`field=basis`)."""

from functools import cache

import warp as wp

from nsf.mpm import Precision
from nsf.mpm.copies import make_copies


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
    typedef {precision.native} real;
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
