"""Axisymmetric collapse of a granular column: the run-out over the aspect ratio."""

from collections.abc import Iterator

import numpy as np

from nsf.mpm import FullOrderMPM
from nsf.scenes import Scene
from nsf.validation.problem import Answer

TITLE = "Collapse of a granular column"
LIMITS = (
    "cells and Coulomb's friction. The foot of a low deposit is thinner than a cell: with 5 and 10 cells "
    "a radius the run-out at a = 1 is 35 and 25 % short; measured once, not in the table: 20 % with 15. "
    "In the experiments neither the material nor the base changed it; here the grains' angle and the floor's "
    "friction decide it, as the rows with others show, and no one angle fits low and tall columns. At 22.8° "
    "the cone, which is matched in triaxial compression, acts as 31° in plane strain."
)
_SOURCE = (
    "Lube et al. 2004, J. Fluid Mech. 508, 175–199: r∞/r₀ = 1 + 1.24 a below a = 1.7, 1 + 1.6 √a above; "
    "sand, salt, couscous, rice and sugar on wood, baize, Plexiglas and sandpaper"
)
_RATIOS, _ROOT = (1.0, 3.0, 6.0, 10.0), 1.7  # aspect ratios a, and that above which the run-out is a root
_LIMIT = "cells; the grains' angle; the floor's friction"  # at a = 1, where rows change each
#: Other friction, one value changed: of the grains [°], of the floor.
_ANGLE, _FLOOR = {"material.friction_angle": 22.8}, {"colliders.floor.friction": 0.3}
_SHARES = np.linspace(0.9, 0.99, 10)  # of the mass, from whose radii the edge is extrapolated


def run_out(scene: Scene, a: float, device: str) -> tuple[FullOrderMPM, float]:
    """The solver at the end, and (r∞ − r₀)/r₀ of a column of height a r₀.

    r∞ is the edge of the deposit without the last grains, which bounced ahead: where the mass outside, which
    falls with the square of the distance from the edge of a cone, is extrapolated to zero.
    """
    column = scene.bodies["column"]
    r0, share = column.shape.radius, a * column.shape.radius / column.shape.height
    keys = {"shape.height": a * r0, "particles": round(share * column.particles)}
    solver = scene.changed({f"bodies.column.{key}": value for key, value in keys.items()}).full_order(
        device=device
    )
    solver.step(scene.steps)
    x = solver.state.x.numpy()[:, :2] - column.shape.base[:2]
    radii = np.quantile(np.hypot(*x.T), _SHARES)
    return solver, float(np.polyfit(np.sqrt(1.0 - _SHARES), radii, 1)[1]) / r0 - 1.0


def answers(scene: Scene, finer: Scene | None, device: str) -> Iterator[Answer]:
    """The run-out at each aspect ratio, the exponent of the tallest, and run-outs with one thing changed."""
    reach = {}
    for a in _RATIOS:
        solver, reach[a] = run_out(scene, a, device)
        yield _answer(solver, a, reach[a], limit=_LIMIT if a == 1.0 else "")
    low, tall = _RATIOS[-2:]
    exponent = np.log(reach[tall] / reach[low]) / np.log(tall / low)
    quantity = f"exponent, a from {low:g} to {tall:g}"
    limit = "two run-outs, whose own errors it has"
    yield Answer.of(solver, quantity, "-", (0.5,), _SOURCE, float(exponent), limit=limit)
    grains = scene.changed(_ANGLE)
    changed = [(1.0, grains, ", 22.8°", "cells"), (6.0, grains, ", 22.8°", "the grains' angle")]
    if finer:
        changed += [(1.0, finer, ", half the cell", "the grains' angle; the floor's friction")]
        changed += [(1.0, finer.changed(_ANGLE), ", half the cell, 22.8°", "the grains' angle")]
        changed += [(1.0, finer.changed(_FLOOR), ", half the cell, floor 0.3", "the floor's friction")]
    for a, other, addition, limit in changed:
        solver, value = run_out(other, a, device)
        yield _answer(solver, a, value, addition, limit)


def _answer(solver: FullOrderMPM, a: float, value: float, addition: str = "", limit: str = "") -> Answer:
    """A run-out beside the published one."""
    published = 1.6 * a**0.5 if a > _ROOT else 1.24 * a
    quantity = f"ΔR/R at a = {a:g}{addition}"
    return Answer.of(solver, quantity, "-", (published,), _SOURCE, value, limit=limit)
