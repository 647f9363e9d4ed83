"""Axisymmetric collapse of a granular column: the run-out over the aspect ratio."""

from collections.abc import Iterator

import numpy as np

from nsf.scenes import Scene
from nsf.validation.problem import Answer

TITLE = "Collapse of a granular column"
LIMITS = (
    "one friction angle: the cone is matched in triaxial compression, and that of 22.8° acts as 31° in plane "
    "strain; low columns feel it, and the floor's friction. Deposits are few cells high."
)
_SOURCE = "Lube et al. 2004"
#: Aspect ratios a below 1.7, and above.
LOW, TALL = (1.0, 1.4), (3.0, 6.0, 10.0)
_IN_PLANE_STRAIN = 22.8  # [°] whose cone acts as 31° there
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
    """Prefactor of low columns, exponent and prefactor of tall ones."""
    for angle in (scene.material.friction_angle, _IN_PLANE_STRAIN):
        of = scene.changed({"material.friction_angle": angle})
        prefactor = np.mean([run_out(of, a, device) / a for a in LOW])
        yield Answer(f"run-out over a, a < 1.7, at {angle:g}°", "-", (1.24,), _SOURCE, float(prefactor))
    tall = np.array([run_out(scene, a, device) for a in TALL])
    exponent = np.polyfit(np.log(TALL), np.log(tall), 1)[0]
    yield Answer("exponent of a, a > 1.7", "-", (0.5,), _SOURCE, float(exponent))
    yield Answer("run-out over √a, a > 1.7", "-", (1.6,), _SOURCE, float((tall / np.sqrt(TALL)).mean()))
