"""Boundaries of the grid: half-spaces and the walls of the domain."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp

from nsf.errors import ConfigError
from nsf.mpm.grid import KINDS
from nsf.mpm.precision import Precision


def _check_kind(kind: str, where: str) -> None:
    if kind not in KINDS:
        raise ConfigError(f"{where}.kind={kind!r} is unknown; choose one of {', '.join(KINDS)}")


@dataclass(frozen=True)
class HalfSpace:
    """The solid half-space {x : (x − point)·normal ≤ 0}; material is on the other side.

    Attributes:
        point: a point of the surface [m].
        normal: outward normal; normalised here.
        kind: `sticky`, `slip` (no normal motion) or `separate` (may lift off).
        friction: Coulomb coefficient of `slip` and `separate`, dimensionless.

    Raises:
        ConfigError: unknown kind, zero normal, a value that is not finite, negative friction,
            friction on `sticky`.
    """

    point: Sequence[float]
    normal: Sequence[float]
    kind: str = "sticky"
    friction: float = 0.0

    def __post_init__(self):
        _check_kind(self.kind, "half-space")
        finite = np.isfinite((*self.point, *self.normal)).all()
        if not (len(self.point) == len(self.normal) == 3 and finite and np.any(self.normal)):
            raise ConfigError(
                f"half-space point={self.point} normal={self.normal}: give 3 numbers each, normal non-zero"
            )
        if not self.friction >= 0:
            raise ConfigError(f"half-space friction={self.friction} must be at least 0")
        if self.kind == "sticky" and self.friction:
            raise ConfigError(
                f"half-space friction={self.friction} has no effect on kind=sticky; use kind=separate"
            )


@dataclass(frozen=True)
class DomainWalls:
    """The six faces of the domain, `padding` nodes deep.

    Attributes:
        kind: as for `HalfSpace`, without friction.
        padding: nodes from the edge on which the condition holds.
    """

    kind: str = "separate"
    padding: int = 3

    def __post_init__(self):
        _check_kind(self.kind, "walls")
        if self.padding < 1:
            raise ConfigError(f"walls.padding={self.padding} must be at least 1 node")


class BoundaryArrays:
    """Half-spaces and walls as the arguments of the grid-update kernel."""

    def __init__(self, colliders: Sequence[HalfSpace], walls: DomainWalls, precision: Precision, device):
        normals = [np.asarray(c.normal, float) / np.linalg.norm(c.normal) for c in colliders]

        def vectors(rows):
            return wp.array(np.array(rows, float).reshape(-1, 3), dtype=precision.vec3, device=device)

        self.point = vectors([c.point for c in colliders])
        self.normal = vectors(normals)
        self.kind = wp.array([KINDS[c.kind] for c in colliders], dtype=wp.int32, device=device)
        self.friction = wp.array([c.friction for c in colliders], dtype=precision.real, device=device)
        self.walls = walls

    @property
    def arguments(self) -> list:
        """In the kernel's order."""
        return [self.point, self.normal, self.kind, self.friction, KINDS[self.walls.kind], self.walls.padding]
