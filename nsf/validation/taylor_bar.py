"""Taylor bar: the radius of a copper bar's foot after its impact on a smooth wall."""

from collections.abc import Iterator

import numpy as np

from nsf.scenes import Scene
from nsf.validation.problem import Answer, position

TITLE = "Taylor bar, copper, 227 m/s"
LIMITS = (
    "cells and time step: APIC loses energy at each step, so that shorter steps make the foot smaller; "
    "finer cells make it larger."
)
_SOURCE = (
    "Foulk et al. 2021, Int. J. Numer. Methods Eng. 122 (7.22); Simo 1992, Comput. Methods Appl. Mech. "
    "Eng. 99, 61–112 (7.12); Zienkiewicz et al. 1998, Int. J. Numer. Methods Eng. 43, 565–583 (7.11)"
)


def answers(scene: Scene, finer: Scene | None, device: str) -> Iterator[Answer]:
    """The radius at the foot: the mean along both planes of symmetry and three directions between."""
    bar = scene.bodies["bar"].shape
    solver = scene.full_order(device=device)
    solver.step(scene.steps)
    radii = []
    for angle in np.radians([0.0, 22.5, 45.0, 67.5, 90.0]):
        rim = position(solver, bar.base + bar.radius * np.array([np.cos(angle), np.sin(angle), 0.0]))
        radii.append(np.hypot(*(rim - bar.base)[:2]))
    quantity = "final radius of the foot"
    yield Answer.of(solver, quantity, "mm", (7.22, 7.12, 7.11), _SOURCE, 1e3 * float(np.mean(radii)))
