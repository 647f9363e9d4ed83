"""Full-order results on disk and as training data.

Names are imported on first use: writing a trajectory needs no torch.
"""

from typing import TYPE_CHECKING

from nsf.extras import on_first_use

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

__getattr__ = on_first_use(__name__)
