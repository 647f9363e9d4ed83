"""Kernels of the networks that a reduced step evaluates once, not at every particle."""

from collections.abc import Sequence
from functools import cache

import warp as wp

from nsf.mpm import Precision
from nsf.mpm.batch import make_runs
from nsf.mpm.native import native_code

_EDGE, _DEEP = 16, 128  # outputs, as many runs, and inputs that a block of a product holds at once


@cache
def _make_side(precision: Precision):
    """Warp struct of a layer of one network, y = act(W x + b): W [out, in], x, b and y of each run.

    W_0 and b_0 are of the layer before it, if it is found anew.
    """
    real = precision.real

    @wp.struct
    class Side:
        W_0: wp.array2d(dtype=real)
        b_0: wp.array2d(dtype=real)
        W: wp.array2d(dtype=real)
        b: wp.array2d(dtype=real)
        x: wp.array2d(dtype=real)
        y: wp.array2d(dtype=real)

    return Side


@cache
def make_layer(precision: Precision, tile: int = 1, several: bool = False, latents: int = 0):
    """Kernel of one layer of two networks at once: act(W x + b), W [out, in], x and b of each run.

    One warp has an output in the runs of a tile. SiLU where `active`, else the identity; the second
    network's outputs follow the first's, `outputs` in all. Where W has fewer columns than there are entries,
    both are of several members, whose rows and entries follow each other. With `latents`, x is what the layer
    before takes, of so many entries: silu(W_0 x + b_0), which every warp finds anew, as a launch costs more.
    """
    real = precision.real
    sums = wp.types.vector(length=tile, dtype=real)
    _, run_of = make_runs(several)
    Side = _make_side(precision)

    @wp.func_native(native_code(__package__, "layer", real=precision.native, TILE=tile, LATENTS=latents))
    def row(one: Side, two: Side, start: int, output: int, lane: int, lanes: int) -> sums: ...

    @wp.func
    def silu(z: real):
        return z / (real(1.0) + wp.exp(-z))

    @wp.kernel(enable_backward=False, module="unique", grid_stride=False)
    def layer(one: Side, two: Side, active: int, lanes: int, outputs: int):
        t = wp.tid()
        at = run_of(t / lanes, outputs)
        o, lane = t / lanes - at * outputs, t % lanes
        start = at * wp.static(tile)
        first = one.b.shape[1]
        z = row(one, two, start, o, lane, lanes)
        if lane != 0:
            return
        for s in range(wp.static(tile)):
            if start + s < one.x.shape[0]:
                y = z[s]
                if active != 0:
                    y = silu(y)
                if o < first:
                    one.y[start + s, o] = y
                else:
                    two.y[start + s, o - first] = y

    return layer


@cache
def make_at_rate(precision: Precision):
    """Kernel of coefficients a = b + M dx̂/dt, a thread each; `outputs` are b and then the columns of M.

    `rate` are those of the displacement's coefficients, of which the first are σ x̂.
    """
    real = precision.real

    @wp.kernel(enable_backward=False, module="unique", grid_stride=False)
    def at_rate(
        outputs: wp.array2d(dtype=real),
        rate: wp.array2d(dtype=wp.float64),
        sigma: wp.array(dtype=wp.float64),
        a: wp.array2d(dtype=real),
    ):
        run, k = wp.tid()
        K = a.shape[1]
        sum = outputs[run, k]
        for j in range(sigma.shape[0]):
            sum += outputs[run, (j + 1) * K + k] * real(rate[run, j] / sigma[j])
        a[run, k] = sum

    return at_rate


def product_blocks(sides: Sequence[tuple[int, int]], runs: int) -> tuple[int, int]:
    """Blocks of `make_product` of the first network for a tile of runs, and of all for all of them.

    Args:
        sides: (outputs, members) of each network.
        runs: of the batch.
    """
    each = [members * -(-outputs // members // _EDGE) for outputs, members in sides]
    return each[0], sum(each) * -(-runs // _EDGE)


@cache
def make_product(precision: Precision):
    """Kernel of a layer as `make_layer`'s for many runs on a GPU, over `blocks` of 128 threads.

    A block has 16 outputs of a member in each of 16 runs; its four warps share the inputs, and add up.
    The blocks of a tile of runs follow each other, the `first` of them are of the first network.
    """
    Side = _make_side(precision)

    @wp.func_native(native_code(__package__, "product", real=precision.native, EDGE=_EDGE, DEEP=_DEEP))
    def multiply(one: Side, two: Side, active: int, first: int, blocks: int): ...

    @wp.kernel(enable_backward=False, module="unique", grid_stride=False)
    def product(one: Side, two: Side, active: int, first: int, blocks: int):
        multiply(one, two, active, first, blocks)

    return product
