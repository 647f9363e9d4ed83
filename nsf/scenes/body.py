"""Bodies of a scene: a shape, and the particles in it."""

import functools
import math
from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass, replace

import numpy as np

from nsf.errors import ConfigError
from nsf.scalars import is_finite
from nsf.scenes.shapes.geometry import Shape
from nsf.scenes.weakness import Weakness
from nsf.vectors import vector

# Particles are numbered with 32 bits.
_MOST = 2**31 - 1


@dataclass(frozen=True)
class Body:
    """Particles of one shape.

    Attributes:
        shape: where the particles are at rest.
        density: reference density [kg/m³].
        particles: how many; or
        particles_per_cell: how many in a grid cell's volume. Exactly one of the two; a body of a
            `Scene` has `particles`.
        velocity: initial velocity [m/s].
        weakness: particles that are softer than the material; none by default.

    Raises:
        ConfigError: not one of the two numbers, or one that is not positive; a density that is not
            positive and finite; a velocity that is not 3 numbers.
    """

    shape: Shape
    _: KW_ONLY
    density: float
    particles: int | None = None
    particles_per_cell: float | None = None
    velocity: Sequence[float] = (0.0, 0.0, 0.0)
    weakness: Weakness | None = None

    def __post_init__(self):
        if (self.particles is None) == (self.particles_per_cell is None):
            raise ConfigError(
                f"particles={self.particles} and particles_per_cell={self.particles_per_cell}: "
                "give exactly one, the other null"
            )
        if self.particles is not None and not (
            is_finite(self.particles) and self.particles >= 1 and self.particles == int(self.particles)
        ):
            raise ConfigError(f"particles={self.particles} must be a whole number, at least 1")
        if self.particles_per_cell is not None and not 0 < self.particles_per_cell < math.inf:
            raise ConfigError(f"particles_per_cell={self.particles_per_cell} must be positive and finite")
        for key, kind in (("shape", Shape), ("weakness", Weakness | None)):
            if not isinstance(getattr(self, key), kind):
                raise ConfigError(
                    f"{key}={getattr(self, key)} must be built; give it a _target_: nsf.scenes.…"
                )
        if not 0 < self.density < math.inf:
            raise ConfigError(f"density={self.density} kg/m³ must be positive and finite")
        vector("velocity", self.velocity, "m/s")

    def check_extent(self, size: Sequence[float], dx: float) -> None:
        """Refuse a body that the grid cannot hold: too large for the domain, or smaller than a cell.

        Args:
            size: domain edge lengths [m].
            dx: grid spacing [m].

        Raises:
            ConfigError: names the body's bounds.
        """
        lower, upper = self.shape.bounds
        if not ((lower >= 0).all() and (upper <= np.asarray(size)).all()):
            unit = ", or set the unit of its mesh, as unit: mm" if hasattr(self.shape, "unit") else ""
            raise ConfigError(
                f"body from {lower} to {upper} m reaches outside the domain [0, {tuple(size)}] m; "
                f"move it or make it smaller{unit}"
            )
        if not (extent := (upper - lower).max()) >= dx:
            raise ConfigError(
                f"body from {lower} to {upper} m is smaller than a cell of scene.dx={dx:g} m in every "
                f"direction, so nothing of it can deform; make it larger, or dx at most {0.25 * extent:.2g} m"
            )

    def counted(self, dx: float) -> "Body":
        """The same body with `particles`, on a grid of spacing dx [m].

        Raises:
            ConfigError: the body is so small that it gets no particle, or gets more than can be numbered.
        """
        if self.particles is not None:
            return self
        cells = self.shape.volume / dx**3
        if not (count := self.particles_per_cell * cells) < _MOST:
            raise ConfigError(
                f"particles_per_cell={self.particles_per_cell} gives {count:.3g} particles; "
                f"give no more than makes {_MOST}"
            )
        if round(count) < 1:
            raise ConfigError(
                f"particles_per_cell={self.particles_per_cell} gives no particle: the body fills {cells:.2g} "
                f"of a cell of dx={dx:g} m; enlarge the body or refine dx"
            )
        return replace(self, particles=round(count), particles_per_cell=None)

    @property
    def files(self) -> dict[str, str]:
        """Path and sha256 of every file that the body is made from."""
        return self.shape.files | (self.weakness.region.files if self.weakness else {})

    def points(self) -> np.ndarray:
        """[P, 3] particles at rest [m]; kept, as placing is slow and parameter values share their bodies."""
        return points_of(self.placing)

    @property
    def placing(self) -> "Placing":
        """A key of all that its points depend on."""
        return Placing(self.shape, self.particles, tuple(self.shape.files.values()))


@dataclass(frozen=True)
class Placing:
    """All that the points of a body depend on; hashed by its text, as shapes hold lists."""

    shape: Shape
    particles: int
    files: tuple[str, ...]

    def __hash__(self):
        return hash((repr(self.shape), self.particles, self.files))


@functools.lru_cache(maxsize=8)
def points_of(placing: Placing) -> np.ndarray:
    """[P, 3] the points [m]."""
    return placing.shape.sample(placing.particles)
