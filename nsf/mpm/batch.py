"""Runs of a batch in the arrays of one run: particles, nodes and solids lie run by run."""

from functools import cache

import warp as wp


@cache
def make_runs(batch: bool):
    """Warp functions (share, run_of) for arrays that hold equally many rows of each run, in turn.

    share: (rows of all, runs) → rows of one.
    run_of: (row, rows of one) → its run.
    Without a batch they give all rows and 0, and the compiler removes them.
    """
    if batch:

        @wp.func
        def share(rows: int, runs: int):
            return rows / runs

        @wp.func
        def run_of(row: int, each: int):
            return row / each

    else:

        @wp.func
        def share(rows: int, runs: int):
            return rows

        @wp.func
        def run_of(row: int, each: int):
            return 0

    return share, run_of
