"""Full-order material point method (paper section 3). Never imports torch.

Names are imported on first use: bodies, laws and boundaries are checked without Warp.
"""

from typing import TYPE_CHECKING

from nsf.extras import on_first_use

if TYPE_CHECKING:
    from nsf.mpm.boundaries.arrays import BoundaryArrays
    from nsf.mpm.boundaries.colliders import Collider, Cuboid, HalfSpace, Sphere, floor_height
    from nsf.mpm.boundaries.motion import Motion
    from nsf.mpm.boundaries.walls import DomainWalls
    from nsf.mpm.forcing import Forcing, Gravity, Hand
    from nsf.mpm.grid.geometry import GridGeometry
    from nsf.mpm.grid.nodes import Grid
    from nsf.mpm.particles import ParticleConstants
    from nsf.mpm.precision import FP32, FP64, Precision, precision_of
    from nsf.mpm.solver import FullOrderMPM, Solver, diagnosed
    from nsf.mpm.state import ParticleState
    from nsf.mpm.step import GridStep
    from nsf.mpm.transfer.scheme import Transfer

__all__ = [
    "FP32",
    "FP64",
    "BoundaryArrays",
    "Collider",
    "Cuboid",
    "DomainWalls",
    "Forcing",
    "FullOrderMPM",
    "Gravity",
    "Grid",
    "GridGeometry",
    "GridStep",
    "HalfSpace",
    "Hand",
    "Motion",
    "ParticleConstants",
    "ParticleState",
    "Precision",
    "Solver",
    "Sphere",
    "Transfer",
    "diagnosed",
    "floor_height",
    "precision_of",
]

__getattr__ = on_first_use(__name__)
