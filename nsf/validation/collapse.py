"""Axisymmetric collapse of a granular column: the run-out over the aspect ratio."""

from collections.abc import Iterator

import numpy as np

from nsf.scenes import Scene
from nsf.validation.problem import Answer

TITLE = "Collapse of a granular column"
LIMITS = (
    "low deposits are few cells high; and run-outs depend on the friction angle, which the published law "
    "lacks. At 22.8° the cone, which is matched in triaxial compression, acts as 31° in plane strain."
)
_SOURCE = "Lube et al. 2004"
_RATIOS, _ROOT = (1.0, 3.0, 6.0, 10.0), 1.7  # aspect ratios a, and that above which the run-out is a root
_OTHER_ANGLE, _OTHER_RATIOS = 22.8, (1.0, 6.0)  # [°]
_SHARES = np.linspace(0.9, 0.99, 10)  # of the mass, from whose radii the edge is extrapolated


def run_out(scene: Scene, a: float, device: str) -> float:
    """(r∞ − r₀)/r₀ of a column of height a r₀.

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
    return float(np.polyfit(np.sqrt(1.0 - _SHARES), radii, 1)[1]) / r0 - 1.0


def answers(scene: Scene, device: str) -> Iterator[Answer]:
    """The run-out at each aspect ratio, at some also with another angle, and the exponent of the tallest."""
    reach = {a: run_out(scene, a, device) for a in _RATIOS}
    other = scene.changed({"material.friction_angle": _OTHER_ANGLE})
    ours = {f"ΔR/R at a = {a:g}": (a, reach[a]) for a in _RATIOS}
    ours |= {f"ΔR/R at a = {a:g}, {_OTHER_ANGLE}°": (a, run_out(other, a, device)) for a in _OTHER_RATIOS}
    for quantity, (a, value) in ours.items():
        yield Answer(quantity, "-", (1.6 * a**0.5 if a > _ROOT else 1.24 * a,), _SOURCE, value)
    low, tall = _RATIOS[-2:]
    exponent = np.log(reach[tall] / reach[low]) / np.log(tall / low)
    yield Answer(f"exponent, a from {low:g} to {tall:g}", "-", (0.5,), _SOURCE, float(exponent))
