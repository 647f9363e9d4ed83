"""Several simulations in the arrays of one: particles, nodes and solids lie simulation by simulation."""

from functools import cache

import warp as wp


@cache
def make_copies(several: bool):
    """Warp functions (share, copy_of) for arrays that hold equally many rows of each simulation, in turn.

    share: (rows of all, simulations) → rows of one.
    copy_of: (row, rows of one) → its simulation.
    For one simulation they give all rows and 0, and the compiler removes them.
    """
    if several:

        @wp.func
        def share(rows: int, copies: int):
            return rows / copies

        @wp.func
        def copy_of(row: int, each: int):
            return row / each

    else:

        @wp.func
        def share(rows: int, copies: int):
            return rows

        @wp.func
        def copy_of(row: int, each: int):
            return 0

    return share, copy_of
