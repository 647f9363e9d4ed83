"""Run folders: what made each, what it holds, and whether that is still what its stage left."""

from typing import TYPE_CHECKING, Any

from nsf.runs.record import Record
from nsf.runs.run import Run

if TYPE_CHECKING:
    from nsf.runs.finding import find, table

__all__ = ["Record", "Run", "find", "table"]


def __getattr__(name: str) -> Any:
    # On demand: a stage that records its run lists none.
    if name in ("find", "table"):
        from nsf.runs import finding

        return getattr(finding, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
