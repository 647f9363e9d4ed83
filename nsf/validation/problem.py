"""The parts that the problems share: an answer, rest by dynamic relaxation, positions of material points."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from nsf.errors import InstabilityError
from nsf.mpm import FullOrderMPM
from nsf.scenes import Box, Scene

#: Steps from one look at the kinetic energy to the next; looks, at most, until a body is at rest.
_BETWEEN, _LOOKS = 10, 5_000


@dataclass(frozen=True)
class Answer:
    """One quantity as published and as computed.

    Attributes:
        quantity: its name; unit: its unit.
        published: the value, or the values whose spread counts as agreement.
        source: of the published values: author, year, and where.
        computed: by a full-order run, of `cell` [m], `particles` and `steps`.
        limit: what keeps the answer off, as measured.
    """

    quantity: str
    unit: str
    published: tuple[float, ...]
    source: str
    computed: float
    cell: float = math.nan
    particles: int = 0
    steps: int = 0
    limit: str = ""

    @classmethod
    def of(cls, solver: FullOrderMPM, *values, limit: str = "") -> "Answer":
        """An answer whose cell, particles and steps are those of a solver at the end of its run."""
        return cls(*values, solver.grid.geometry.dx, len(solver.constants), solver.steps_taken, limit)

    @property
    def difference(self) -> float:
        """[%] from the nearest published value, 0 within their spread; where 0 is published, in the unit."""
        low, high = min(self.published), max(self.published)
        nearest = min(max(self.computed, low), high)
        return 100.0 * (self.computed / nearest - 1.0) if nearest else self.computed


def relax(solver: FullOrderMPM, load: Callable[[], object] = lambda: None, still: float = 3e-8) -> None:
    """Bring a body to rest by kinetic damping: at each peak of kinetic energy all velocities become zero.

    Args:
        solver: at any state.
        load: called before each step.
        still: share of the highest peak of kinetic energy at which the body counts as at rest.

    Raises:
        InstabilityError: it does not come to rest.
    """
    before = highest = 0.0
    for _ in range(_LOOKS):
        for _ in range(_BETWEEN):
            load()
            solver.step()
        energy = kinetic_energy(solver)
        if not math.isfinite(energy):
            break
        if energy < before:
            solver.state.v.rows.zero_()
            solver.state.C.rows.zero_()
            if before < still * highest:
                return
            highest, energy = max(highest, before), 0.0
        before = energy
    raise InstabilityError(
        f"{solver.steps_taken} steps bring no rest (kinetic energy {energy:.3g} J); set a smaller scene.dt"
    )


def kinetic_energy(solver: FullOrderMPM) -> float:
    """Σ ½ m |v|² [J]."""
    v = solver.state.v.numpy().astype(float)
    return float(0.5 * solver.constants.mass @ (v**2).sum(1))


def position(solver: FullOrderMPM, X: np.ndarray) -> np.ndarray:
    """[3] where the material point X [3] [m] is, by a linear fit to the particles that were within 1.5 Δx."""
    arms = solver.constants.X - X
    near = np.abs(arms).max(1) < 1.5 * solver.grid.geometry.dx
    terms = np.column_stack([np.ones(near.sum()), arms[near]])
    return np.linalg.lstsq(terms, solver.state.x.numpy()[near].astype(float), rcond=None)[0][0]


def spread(scene: Scene, body: str) -> Scene:
    """The scene with the particles of a body spread evenly, as in other scenes, in place of on a lattice."""
    lattice = scene.bodies[body].shape
    return scene.changed({f"bodies.{body}.shape": Box(lattice.lower, lattice.upper)})
