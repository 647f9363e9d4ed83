"""Taylor bar: the radius of a copper bar's foot after its impact on a smooth wall."""

from collections.abc import Iterator

import numpy as np

from nsf.scenes import Scene
from nsf.validation.problem import Answer, position

TITLE = "Taylor bar, copper, 227 m/s"
LIMITS = (
    "cells and time step: APIC loses energy at each step, so that shorter steps make the foot smaller; finer "
    "cells make it larger."
)


def answers(scene: Scene, device: str) -> Iterator[Answer]:
    """The radius at the foot, along both planes of symmetry and the diagonal between."""
    bar = scene.bodies["bar"].shape
    solver = scene.full_order(device=device)
    solver.step(scene.steps)
    radii = []
    for angle in np.radians([0.0, 22.5, 45.0, 67.5, 90.0]):
        rim = position(solver, bar.base + bar.radius * np.array([np.cos(angle), np.sin(angle), 0.0]))
        radii.append(np.hypot(*(rim - bar.base)[:2]))
    yield Answer(
        "final radius of the foot", "mm", (7.22, 7.12, 7.11), "Foulk 2021, Simo 1992, Zienkiewicz 1998",
        1e3 * float(np.mean(radii)),
    )  # fmt: skip
