"""Run folders: what made each, what it holds, and whether that is still what its stage left."""

from typing import TYPE_CHECKING

from nsf.extras import on_first_use
from nsf.runs.record import Record
from nsf.runs.run import Run

if TYPE_CHECKING:
    from nsf.runs.finding import table

__all__ = ["Record", "Run", "table"]

# On demand: a stage that records its run lists none.
__getattr__ = on_first_use(__name__)
