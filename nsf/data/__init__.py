"""Full-order results on disk and as training data.

Names are imported on first use: writing a trajectory needs no torch.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from nsf.data.case import PROGRAM, Case
    from nsf.data.normalize import Standardizer
    from nsf.data.schema import TAU_MATRIX, TAU_ORDER, hash_of_positions
    from nsf.data.snapshots import Snapshots
    from nsf.data.split import Split
    from nsf.data.trajectory import Trajectory, TrajectoryWriter

__all__ = [
    "PROGRAM",
    "TAU_MATRIX",
    "TAU_ORDER",
    "Case",
    "Snapshots",
    "Split",
    "Standardizer",
    "Trajectory",
    "TrajectoryWriter",
    "hash_of_positions",
]

_HOMES = {
    "PROGRAM": "case",
    "Case": "case",
    "Standardizer": "normalize",
    "Snapshots": "snapshots",
    "Split": "split",
    "Trajectory": "trajectory",
    "TrajectoryWriter": "trajectory",
}


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOMES.get(name, 'schema')}"), name)
