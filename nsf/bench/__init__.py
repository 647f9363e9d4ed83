"""`nsf bench`: the time of a step, how near it is to the memory's bandwidth, and how it grows.

A benchmark is a module of `BENCHES` with `run(figures)`, which adds rows to one long table. The frame has
the rows of the others, too, and of one that was interrupted, and draws all.
"""

from nsf.bench.command import BENCHES, bench
from nsf.bench.report import table

__all__ = ["BENCHES", "bench", "table"]
