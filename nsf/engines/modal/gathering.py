"""Kernels of a reduced step whose fields are modes times coefficients (`field=basis`).

Nothing here is read back to the host, and no launch depends on a value, so a step is one CUDA graph.
A few sums go over the threads of a block or of a warp by native code; on a CPU a block is one thread.
What each of several runs has of its own lies run by run in the arrays; modes and weights
are common to all, and a thread reads them once for a tile of runs.
"""

from functools import cache

import warp as wp

from nsf.mpm import Precision
from nsf.mpm.batch import make_runs
from nsf.mpm.native import native_code
from nsf.mpm.native.access import SHARED, TAKEN

THREADS = 128  # of a block that shares coefficients, or a sum over S
_TILE = 8  # most runs of one thread: their sums fill its registers
_NATIVE = {wp.float16: "wp::half", wp.float32: "float"}


def tiling(runs: int, shared: int = 0) -> tuple[int, int]:
    """Tiles, and runs of a tile, so that none is much emptier than the others.

    Args:
        runs: in all.
        shared: memory [byte] that a block shares for each run of its tile.
    """
    most = max(1, min(_TILE, (SHARED - TAKEN) // max(shared, 1)))
    tiles = -(-runs // most)
    return tiles, -(-runs // tiles)


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


@cache
def make_combination(
    precision: Precision, vectors: int, sums: int, tile: int, several: bool, coefficients, stored
):
    """Warp function of the sums Σ_k modes[p, c..c+2, k] a_k, for each run of a tile, and as many of b.

    On a GPU all threads of a block call it, also those beyond the last particle; one that is not `live` only
    helps to share the coefficients. A CPU may change the order of additions.

    Args:
        precision: of the sums.
        vectors: those of four modes.
        sums: one, of a alone, or two.
        tile, several: runs of a tile, from `start` on, and whether there are more tiles.
        coefficients: type of a and b.
        stored: type of modes, which are as of `Arena.placed`; fp16 on a GPU alone.
    """
    real = precision.real
    values = wp.types.vector(length=3 * sums * tile, dtype=real)
    types = {"real": precision.native, "stored": _NATIVE[stored]}

    @wp.func_native(
        native_code(__package__, "combination", **types, Q=vectors, SUMS=sums, TILE=tile, SEVERAL=several)
    )
    def combined(
        modes: wp.array(dtype=stored),
        lengths: wp.array(dtype=real),
        rows: wp.array(dtype=wp.int32),
        a: wp.array2d(dtype=coefficients),
        b: wp.array2d(dtype=coefficients),
        particles: int,
        components: int,
        start: int,
        p: int,
        c: int,
        live: bool,
    ) -> values: ...

    return combined


@cache
def _make_field_arrays(precision: Precision, coefficients, stored):
    """Warp struct of a matrix field, mean + Σ_k modes_k a_k: its factors, and `found`, where it goes."""
    real = precision.real

    @wp.struct
    class Field:
        mean: wp.array2d(dtype=real)
        modes: wp.array(dtype=stored)
        lengths: wp.array(dtype=real)
        rows: wp.array(dtype=wp.int32)
        a: wp.array2d(dtype=coefficients)
        values: wp.array3d(dtype=real)

    return Field


@cache
def _make_field(precision: Precision, vectors: int, coefficients, tile: int, several: bool, stored):
    """Warp function of `make_contraction` for one of its fields; t is a thread's number in the field."""
    vec3 = precision.vec3
    combined = make_combination(precision, vectors, 1, tile, several, coefficients, stored)
    Field = _make_field_arrays(precision, coefficients, stored)

    @wp.func
    def field(in_N: wp.array2d(dtype=wp.int32), its: Field, start: int, t: int):
        n, components = in_N.shape[1], its.mean.shape[1]
        groups = components / 3
        if wp.static(several):  # what a warp stores then lies together, which gains more than its loads lose
            group, p = t % groups, t / groups
        else:
            group, p = t / n, t % n
        c = 3 * group
        bits = 0
        if c < components and p < n:
            bits = in_N[start / wp.static(tile), p]
        live = bits != 0
        middle = vec3()
        if live:  # loaded before all that is waited for below
            middle = vec3(its.mean[p, c], its.mean[p, c + 1], its.mean[p, c + 2])
        value = combined(
            its.modes, its.lengths, its.rows, its.a, its.a, its.mean.shape[0], components, start, p, c, live
        )
        if not live:
            return
        for s in range(wp.static(tile)):
            if (bits & wp.static(1 << s)) != 0:
                row = (start + s) * n + p
                one = value[3 * s] + middle[0]
                two = value[3 * s + 1] + middle[1]
                three = value[3 * s + 2] + middle[2]
                if components == 9:
                    its.values[row, group, 0] = one
                    its.values[row, group, 1] = two
                    its.values[row, group, 2] = three
                elif group == 0:
                    its.values[row, 0, 0] = one
                    its.values[row, 0, 1] = two
                    its.values[row, 1, 0] = two
                    its.values[row, 0, 2] = three
                    its.values[row, 2, 0] = three
                else:
                    its.values[row, 1, 1] = one
                    its.values[row, 1, 2] = two
                    its.values[row, 2, 1] = two
                    its.values[row, 2, 2] = three

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

    A thread has three components of a particle, in the runs of a tile; `several` tiles have blocks in
    turn. The first `threads` are those of the first field. The six components of a symmetric field are xx xy
    xz yy yz zz, the nine of another go row by row. Nothing is written where the bit of a run in `in_N`
    is not set, see `make_neighbours`. `vectors` are those of four modes of either field, `coefficients` the
    type of a, `stored` that of modes.
    """
    tile_of, within = make_tiles(several)
    Field = _make_field_arrays(precision, coefficients, stored)
    first, second = (_make_field(precision, Q, coefficients, tile, several, stored) for Q in vectors)

    @wp.kernel(enable_backward=False, module="unique", grid_stride=False)
    def contraction(
        in_N: wp.array2d(dtype=wp.int32), one: Field, two: Field, threads: int, tiles: int, lanes: int
    ):
        t = within(wp.tid(), tiles, lanes)
        start = tile_of(wp.tid(), tiles, lanes) * wp.static(tile)
        if t < threads:  # whole blocks
            first(in_N, one, start, t)
        else:
            second(in_N, two, start, t - threads)

    return contraction


@cache
def _make_gathered(precision: Precision):
    """Warp struct of what `make_gathering` reads, and of b.

    `displacement` holds the modes of S alone; v has `rows` of each run, S first; w_p are `weights`.
    """

    @wp.struct
    class Gathered:
        displacement: wp.array(dtype=wp.float32)
        v: wp.array(dtype=precision.vec3)
        rows: int
        weights: wp.array(dtype=wp.float64)
        dt: wp.float64
        b: wp.array2d(dtype=wp.float64)

    return Gathered


@cache
def make_gathering(precision: Precision, several: bool = False):
    """Kernel of the sums of S for the projection, one block a run and mode: b_k = Σ_p w_p B_p,kᵀ Δt v_p.

    The displacement of S in the step is Δt v_p, as its positions before it lie on the manifold. The last
    block of a run gives Σ_p w_p |Δt v_p|².
    """
    _, run_of = make_runs(several)
    Gathered = _make_gathered(precision)

    @wp.func_native(native_code(__package__, "gathering"))
    def share(gathered: Gathered, run: int, k: int, lane: int, lanes: int) -> wp.float64: ...

    @wp.kernel(enable_backward=False, module="unique", grid_stride=False)
    def gathering(gathered: Gathered, lanes: int):
        t = wp.tid()
        sums = gathered.b.shape[1]
        run = run_of(t / lanes, sums)
        k, lane = t / lanes - run * sums, t % lanes
        total = share(gathered, run, k, lane, lanes)
        if lane == 0:
            gathered.b[run, k] = total

    return gathering
