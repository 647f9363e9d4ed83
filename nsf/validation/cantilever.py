"""Cantilever under a dead load at its tip: large deflections of the elastica."""

from collections.abc import Iterator

import numpy as np

from nsf.scenes import Scene
from nsf.validation.problem import Answer, position, relax

TITLE = "Cantilever under a dead tip load"
LIMITS = "shear, which the elastica has not."
#: P L²/EI → w/L and u/L of the tip.
ELASTICA = {1: (0.30172, 0.05643), 2: (0.49346, 0.16064), 5: (0.71379, 0.38763), 10: (0.81061, 0.55500)}


def answers(scene: Scene, device: str) -> Iterator[Answer]:
    """Deflections of the tip at rest, from each load to the next; the last cell of the beam carries it."""
    beam = scene.bodies["beam"].shape
    L, b, h = np.subtract(beam.upper, beam.lower)
    tip = np.array([beam.upper[0], *(0.5 * np.add(beam.lower, beam.upper))[1:]])
    solver = scene.changed({"gravity": [0.0, 0.0, 0.0]}).full_order(device=device)
    loaded = solver.constants.X[:, 0] > beam.upper[0] - scene.dx
    for ratio, published in ELASTICA.items():
        P = ratio * scene.material.E * b * h**3 / 12.0 / L**2
        impulse = np.zeros((len(loaded), 3))
        impulse[loaded, 2] = -P * scene.dt / solver.constants.mass[loaded].sum()

        def load(impulse=impulse):
            solver.state.v.assign(solver.state.v.numpy() + impulse)

        relax(solver, load)
        moved = position(solver, tip) - tip
        for name, axis, value in zip(("w", "u"), (2, 0), published, strict=True):
            quantity = f"{name}/L at P L²/EI = {ratio}"
            yield Answer(quantity, "-", (value,), "elastica, elliptic integrals", -float(moved[axis]) / L)
