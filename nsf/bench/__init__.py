"""`nsf bench`: what a step costs, how near it is to the memory's bandwidth, and how it grows.

A benchmark is a module of `BENCHES` with `run(settings, found, say)`, which adds rows to a `Result`; the
frame gives it the settings, keeps the rows of the others and of one that was interrupted, and draws all.
"""

from nsf.bench.command import BENCHES, bench
from nsf.bench.report import table

__all__ = ["BENCHES", "bench", "table"]
