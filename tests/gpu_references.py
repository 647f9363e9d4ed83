"""References of the tests marked `gpu`: a trained manifold, and reduced steps that a CPU took with it.

A GPU machine may have a Warp that compiles nothing for a CPU, so `make gpu-references` writes them on a
machine that does. The manifold is trained where it is missing; the steps are always taken anew.
"""

import shutil
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace

import numpy as np

import nsf
from nsf import Manifold
from nsf.dynamics import GaussNewton, Sources

FOLDER = Path(__file__).parent / "references"
MANIFOLD, STEPS = FOLDER / "manifold.pt", FOLDER / "steps.npz"
SOURCES = [Sources(stress, affine) for stress in ("field", "deformation") for affine in ("field", "none")]
TOLERANCES = (1e-6, 0.1)  # of the projector; with the larger one update is enough in every step
KEPT = ("xhat", "residuals", "updates", "stops")


def manifold() -> Manifold:
    """The manifold of the tiny chain, as it was committed."""
    return Manifold.load(MANIFOLD)


def steps(scene, manifold, device: str, sources: Sources, tolerance: float, **options):
    """Trajectory of 24 steps of the modal engine with |S| = 60."""
    projector = GaussNewton(tolerance=tolerance)
    options |= {"sources": sources, "device": device, "projector": projector}
    solver = nsf.reduced(scene, manifold, {"friction_angle": 26.0}, 60, **options)
    solver.step(24)
    return solver.trajectory()


def steps_of_a_cpu(sources: Sources, tolerance: float) -> SimpleNamespace:
    """The same, as they were committed: x̂ [25, r], residuals, updates and stops."""
    with np.load(STEPS) as kept:
        found = {name: kept[_key(sources, tolerance, name)] for name in KEPT}
    return SimpleNamespace(**found | {"stops": found["stops"].tolist()})


def _key(sources: Sources, tolerance: float, name: str) -> str:
    return f"{sources.stress == 'field'}{sources.affine == 'field'} {tolerance} {name}"


def write() -> None:
    """Write what is missing of the manifold, and the steps."""
    from tiny import tiny_pipeline

    FOLDER.mkdir(exist_ok=True)
    with TemporaryDirectory() as root:
        pipeline = tiny_pipeline(Path(root))
        if not MANIFOLD.exists():
            pipeline.run("simulate")
            pipeline.run("train")
            shutil.copyfile(pipeline.training.path / "manifold.pt", MANIFOLD)
    found = {}
    for sources, tolerance in product(SOURCES, TOLERANCES):
        trajectory = steps(pipeline.scene, manifold(), "cpu", sources, tolerance)
        found |= {_key(sources, tolerance, name): getattr(trajectory, name) for name in KEPT}
    np.savez_compressed(STEPS, **found)


if __name__ == "__main__":
    write()
