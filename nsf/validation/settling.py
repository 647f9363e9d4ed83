"""Elastic column at rest under its own weight: the stress along it."""

from collections.abc import Iterator

import numpy as np

from nsf.mpm import FullOrderMPM
from nsf.scenes import Scene
from nsf.validation.problem import Answer, relax, spread

TITLE = "Column under its own weight"
LIMITS = (
    "the lowest cells, whose strain the floor holds: single particles are 6.1 % off with them and 1.0 % "
    "above two cells. Particles spread as in other scenes are noisy from the start: the last row."
)
_SOURCE = "closed form: equilibrium, σ = ρ₀ g (l₀ − y₀)"
_HELD = 2  # cells above the floor that the second distance leaves out


def answers(scene: Scene, finer: Scene | None, device: str) -> Iterator[Answer]:
    """Vertical Cauchy stress against ρ₀ g (l₀ − y₀): the slope, and the distance of particles from it."""
    solver, stress, exact = stresses(scene, device)
    slope = float(np.polyfit(exact, stress, 1)[0])
    yield Answer.of(solver, "stress over ρ₀ g (l₀ − y₀), slope", "-", (1.0,), _SOURCE, slope)
    quantity = "single particles' distance from it"
    limit = "the lowest cell, at the floor"
    yield Answer.of(solver, quantity, "%", (0.0,), _SOURCE, distance(stress, exact), limit=limit)
    column = scene.bodies["column"].shape
    above = solver.constants.X[:, 2] > column.lower[2] + _HELD * scene.dx
    quantity = f"the same, {_HELD} cells above the floor"
    yield Answer.of(solver, quantity, "%", (0.0,), _SOURCE, distance(stress[above], exact[above]))
    solver, stress, exact = stresses(spread(scene, "column"), device)
    limit = "particles off the lattice, as other scenes have them"
    quantity = "the same, particles spread"
    yield Answer.of(solver, quantity, "%", (0.0,), _SOURCE, distance(stress, exact), limit=limit)


def stresses(scene: Scene, device: str) -> tuple[FullOrderMPM, np.ndarray, np.ndarray]:
    """The solver at rest, and [P] vertical pressure and ρ₀ g (l₀ − y₀) [Pa]."""
    column = scene.bodies["column"]
    solver = scene.full_order(device=device)
    relax(solver)
    state, z = solver.state.numpy(), solver.constants.X[:, 2]
    pressure = -state["tau"][:, 2, 2] / np.linalg.det(state["F_e"])
    return solver, pressure, -column.density * scene.gravity[2] * (column.shape.upper[2] - z)


def distance(stress: np.ndarray, exact: np.ndarray) -> float:
    """Root mean square over that of the exact one [%]."""
    return float(100.0 * np.linalg.norm(stress - exact) / np.linalg.norm(exact))
