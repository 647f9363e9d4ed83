"""Full-order material point method (paper section 3). Never imports torch."""

import os
from contextlib import suppress

import warp as wp

from nsf.gpu import has_driver

wp.config.log_level = wp.LOG_ERROR  # kernels are compiled without a word; errors still show


def _begin_without_gpu() -> None:
    """Start Warp where no GPU can be, without its warning; `nsf doctor` says what is missing."""
    with suppress(OSError), open(os.devnull, "wb") as nowhere:
        stderr = os.dup(2)  # the warning comes from C++, which knows no sys.stderr
        try:
            os.dup2(nowhere.fileno(), 2)
            wp.init()
        finally:
            os.dup2(stderr, 2)
            os.close(stderr)


if not has_driver():
    _begin_without_gpu()

from nsf.mpm.boundaries.arrays import BoundaryArrays, DomainWalls  # noqa: E402
from nsf.mpm.boundaries.colliders import Collider, Cuboid, HalfSpace, Sphere, floor_height  # noqa: E402
from nsf.mpm.boundaries.motion import Motion  # noqa: E402
from nsf.mpm.forcing import Forcing, Gravity, Hand  # noqa: E402
from nsf.mpm.grid.nodes import Grid, GridGeometry  # noqa: E402
from nsf.mpm.precision import FP32, FP64, Precision, precision_of  # noqa: E402
from nsf.mpm.solver import FullOrderMPM, Solver, diagnosed  # noqa: E402
from nsf.mpm.state import ParticleConstants, ParticleState  # noqa: E402
from nsf.mpm.step import GridStep  # noqa: E402
from nsf.mpm.stressed import stressed  # noqa: E402
from nsf.mpm.transfer import Transfer  # noqa: E402

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
    "stressed",
]
