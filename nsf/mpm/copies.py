"""Several simulations in the arrays of one: particles, nodes and solids lie simulation by simulation."""

from functools import cache

import warp as wp


@cache
def make_copies(several: bool):
    """Warp functions (share, copy_of) of arrays that hold as many rows of each simulation, one by one.

    share: (rows of all, simulations) → rows of one.
    copy_of: (row, rows of one) → its simulation.
    Unless there are several, these are all rows and 0, and a compiler leaves nothing of them.
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
