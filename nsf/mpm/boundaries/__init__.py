"""What a body meets: colliders, the domain's walls, their motion and contact."""

from nsf.mpm.boundaries.arrays import BoundaryArrays, DomainWalls
from nsf.mpm.boundaries.colliders import Collider, Cuboid, HalfSpace, Sphere, floor_height
from nsf.mpm.boundaries.motion import Motion

__all__ = [
    "BoundaryArrays",
    "Collider",
    "Cuboid",
    "DomainWalls",
    "HalfSpace",
    "Motion",
    "Sphere",
    "floor_height",
]
