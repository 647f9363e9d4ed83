"""Block on an incline: how far it slides by Coulomb's friction."""

import math
from collections.abc import Iterator

from nsf.scenes import Scene
from nsf.validation.problem import Answer

TITLE = "Block on an incline, Coulomb"
LIMITS = "the start: the block slides as a whole once a shear wave has crossed it."


def answers(scene: Scene, finer: Scene | None, device: str) -> Iterator[Answer]:
    """The way of the mass centre against ½ g t² (sin θ − μ cos θ)."""
    theta, friction = math.radians(scene.inclination.angle), scene.colliders["plane"].friction
    solver = scene.full_order(device=device)
    solver.step(scene.steps)
    moved = (solver.state.x.numpy() - solver.constants.X).mean(0)
    way = -0.5 * scene.gravity[2] * scene.duration**2 * (math.sin(theta) - friction * math.cos(theta))
    down = math.copysign(1.0, scene.base_gravity[0])
    name = f"way in {scene.duration:.3g} s"
    source = "closed form: ½ g t² (sin θ − μ cos θ)"
    yield Answer.of(solver, name, "m", (round(way, 6),), source, down * float(moved[0]))
