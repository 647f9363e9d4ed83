"""Elastic column at rest under its own weight: the stress along it."""

from collections.abc import Iterator

import numpy as np

from nsf.scenes import Scene
from nsf.validation.problem import Answer, relax

TITLE = "Column under its own weight"
LIMITS = "the cells at the floor, and the noise of particles that are spread evenly and not on a lattice."


def answers(scene: Scene, device: str) -> Iterator[Answer]:
    """Vertical Cauchy stress against ρ₀ g (l₀ − y₀)."""
    column = scene.bodies["column"]
    solver = scene.full_order(device=device)
    relax(solver)
    state, z = solver.state.numpy(), solver.constants.X[:, 2]
    stress = -state["tau"][:, 2, 2] / np.linalg.det(state["F_e"])
    exact = -column.density * scene.gravity[2] * (column.shape.upper[2] - z)
    slope = np.polyfit(exact, stress, 1)[0]
    source = "equilibrium"
    yield Answer("stress over ρ₀ g (l₀ − y₀), slope", "-", (1.0,), source, float(slope))
    off = 100.0 * np.linalg.norm(stress - exact) / np.linalg.norm(exact)
    yield Answer("distance from ρ₀ g (l₀ − y₀)", "%", (0.0,), source, float(off))
