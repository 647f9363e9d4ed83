"""Cantilever under a dead load at its tip: large deflections of the elastica."""

from collections.abc import Iterator

import numpy as np

from nsf.scenes import Scene
from nsf.validation.problem import Answer, position, relax, spread

TITLE = "Cantilever under a dead tip load"
LIMITS = (
    "three cells a thickness, too soft where the beam curves strongly; shear and stretch, which the "
    "elastica lacks. I is of the particles; those spread as in other scenes are farther off: the last row."
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
    """w/L and u/L at each load in turn."""
    beam = scene.bodies["beam"].shape
    L, middle = beam.upper[0] - beam.lower[0], 0.5 * np.add(beam.lower, beam.upper)
    tip = np.array([beam.upper[0], *middle[1:]])
    solver = scene.changed({"gravity": [0.0, 0.0, 0.0]}).full_order(device=device)
    constants = solver.constants
    EI = scene.material.E * float(constants.volume0 @ (constants.X[:, 2] - middle[2]) ** 2) / L
    share = tip_share(constants.X[:, 0], tip[0], scene.dx)
    for ratio in ELASTICA:
        P = ratio * EI / L**2
        added = np.zeros_like(constants.X)
        added[:, 2] = -P * scene.dt * share / constants.mass
        relax(solver, lambda added=added: solver.state.v.assign(solver.state.v.numpy() + added))
        moved = position(solver, tip) - tip
        yield -float(moved[2]) / L, -float(moved[0]) / L


def tip_share(x: np.ndarray, tip: float, dx: float) -> np.ndarray:
    """[P] share of the load on each particle of the last cell, whose resultant is at the tip; 0 on others."""
    last = x > tip - dx
    arm = x[last] - x[last].mean()
    share = np.zeros(len(x))
    share[last] = (1.0 + (tip - x[last].mean()) / (arm**2).mean() * arm) / last.sum()
    return share
