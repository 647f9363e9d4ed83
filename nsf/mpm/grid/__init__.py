"""The background grid: its nodes, their storage and interpolation weights (paper sections 3.2 and 3.3)."""

from nsf.mpm.grid.nodes import (
    BLOCK,
    Grid,
    GridGeometry,
    flat_index,
    inside,
    make_reach,
    node_of,
    node_of_step,
    nodes_of_step,
    storage,
)

__all__ = [
    "BLOCK",
    "Grid",
    "GridGeometry",
    "flat_index",
    "inside",
    "make_reach",
    "node_of",
    "node_of_step",
    "nodes_of_step",
    "storage",
]
