"""Cantilever under a dead load at its tip: large deflections of the elastica."""

from collections.abc import Iterator

import numpy as np

from nsf.scenes import Scene
from nsf.validation.problem import Answer, position, relax, spread

TITLE = "Cantilever under a dead tip load"
LIMITS = (
    "six layers of particles, whose second moment is 2.8 % below the section's; shear and stretch, which the "
    "elastica lacks. Particles spread as in other scenes are farther off: the last row."
)
_SOURCE = "elastica"
#: P L²/EI → w/L and u/L of the tip.
ELASTICA = {1: (0.30172, 0.05643), 2: (0.49346, 0.16064), 5: (0.71379, 0.38763), 10: (0.81061, 0.55500)}


def answers(scene: Scene, device: str) -> Iterator[Answer]:
    """Deflections w down and u back of the tip at rest, from each load to the next."""
    for (ratio, published), moved in zip(ELASTICA.items(), deflections(scene, device), strict=True):
        for name, value, ours in zip("wu", published, moved, strict=True):
            yield Answer(f"{name}/L at P L²/EI = {ratio}", "-", (value,), _SOURCE, ours)
    quantity = "w/L at P L²/EI = 1, particles spread"
    yield Answer(quantity, "-", ELASTICA[1][:1], _SOURCE, next(deflections(spread(scene, "beam"), device))[0])


def deflections(scene: Scene, device: str) -> Iterator[tuple[float, float]]:
    """w/L and u/L at each load in turn, which the last cell of the beam carries."""
    beam = scene.bodies["beam"].shape
    L, b, h = np.subtract(beam.upper, beam.lower)
    tip = np.array([beam.upper[0], *(0.5 * np.add(beam.lower, beam.upper))[1:]])
    solver = scene.changed({"gravity": [0.0, 0.0, 0.0]}).full_order(device=device)
    loaded = solver.constants.X[:, 0] > beam.upper[0] - scene.dx
    for ratio in ELASTICA:
        P = ratio * scene.material.E * b * h**3 / 12.0 / L**2
        impulse = np.zeros((len(loaded), 3))
        impulse[loaded, 2] = -P * scene.dt / solver.constants.mass[loaded].sum()
        relax(solver, lambda added=impulse: solver.state.v.assign(solver.state.v.numpy() + added))
        moved = position(solver, tip) - tip
        yield -float(moved[2]) / L, -float(moved[0]) / L
