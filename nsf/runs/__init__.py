"""Run folders: what made each, what it holds, and whether that is still what its stage left."""

from nsf.runs.record import Record
from nsf.runs.run import Run

__all__ = ["Record", "Run"]
