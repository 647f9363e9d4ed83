"""Cantilever under a dead load at its tip: large deflections of the elastica."""

from collections.abc import Iterator, Sequence

import numpy as np

from nsf.mpm import FullOrderMPM
from nsf.scenes import Scene
from nsf.validation.problem import Answer, position, relax, spread

TITLE = "Cantilever under a dead tip load"
LIMITS = (
    "the grip, which holds the first half cell straight, and quadrature: where the beam has turned, few "
    "particles a cell resolve its bending too softly. With 4 of them u/L at P L²/EI = 2 is 6.0 % off after "
    "the load of 1; measured once, not in the table: 2.7 % under that load at once, 11 % under a slow one. "
    "The grip makes the beam stiff and quadrature makes it soft: with half the cell u/L at 2 goes from 0.0 "
    "to 1.3 % off. Shear and stretch, which the elastica lacks, add 0.2 to 0.9 % by Reissner's beam of this "
    "slenderness, which is not in the table. I is of the particles."
)
_SOURCE = "Mattiasson 1981, Int. J. Numer. Methods Eng. 17, 145–153; tests solve the elastica again"
#: P L²/EI → w/L and u/L of the tip.
ELASTICA = {1: (0.30172, 0.05643), 2: (0.49346, 0.16064), 5: (0.71379, 0.38763), 10: (0.81061, 0.55500)}
_FEW = 2  # particles a cell in each direction of the plane, where the scene has 3


def answers(scene: Scene, finer: Scene | None, device: str) -> Iterator[Answer]:
    """Deflections w down and u back of the tip at rest, from each load to the next."""
    yield from _answers(scene, ELASTICA, device)
    if finer:
        yield from _answers(finer, (1, 2), device, ", half the cell")
    spacing, particles = scene.dx / _FEW, _FEW**3 * round(scene.bodies["beam"].shape.volume / scene.dx**3)
    few = scene.changed({"bodies.beam.shape.spacing": spacing, "bodies.beam.particles": particles})
    limit = f"{_FEW**2} particles a cell in the plane; the scene has 9"
    yield from _answers(few, (1, 2), device, f", {_FEW**2} particles a cell", limit)
    limit = "particles off the lattice, as other scenes have them"
    yield from _answers(spread(scene, "beam"), (1,), device, ", particles spread", limit)


def _answers(
    scene: Scene, ratios: Sequence[int], device: str, addition: str = "", limit: str = ""
) -> Iterator[Answer]:
    """w/L and u/L at each load in turn."""
    for ratio, (solver, moved) in zip(ratios, deflections(scene, ratios, device), strict=True):
        for name, published, ours in zip("wu", ELASTICA[ratio], moved, strict=True):
            quantity = f"{name}/L at P L²/EI = {ratio}{addition}"
            yield Answer.of(solver, quantity, "-", (published,), _SOURCE, ours, limit=limit)


def layer(scene: Scene) -> Scene:
    """The scene with one layer of the beam's particles: between smooth plates all layers move alike."""
    beam = scene.bodies["beam"].shape
    width = getattr(beam, "spacing", scene.dx / 3.0)
    upper = [beam.upper[0], beam.lower[1] + width, beam.upper[2]]
    particles = round(scene.bodies["beam"].particles * width / (beam.upper[1] - beam.lower[1]))
    plate = {"colliders.back.point": [0.0, upper[1], 0.0]}
    return scene.changed({"bodies.beam.shape.upper": upper, "bodies.beam.particles": particles} | plate)


def deflections(
    scene: Scene, ratios: Sequence[int], device: str
) -> Iterator[tuple[FullOrderMPM, tuple[float, float]]]:
    """The solver, and w/L and u/L, at rest under each load P = ratio · EI/L² in turn."""
    scene = layer(scene)
    beam = scene.bodies["beam"].shape
    L, middle = beam.upper[0] - beam.lower[0], 0.5 * np.add(beam.lower, beam.upper)
    tip = np.array([beam.upper[0], *middle[1:]])
    solver = scene.changed({"gravity": [0.0, 0.0, 0.0]}).full_order(device=device)
    constants = solver.constants
    EI = scene.material.E * float(constants.volume0 @ (constants.X[:, 2] - middle[2]) ** 2) / L
    share = tip_share(constants.X[:, 0], tip[0], scene.dx)
    for ratio in ratios:
        P = ratio * EI / L**2
        added = np.zeros_like(constants.X)
        added[:, 2] = -P * scene.dt * share / constants.mass
        relax(solver, lambda added=added: solver.state.v.assign(solver.state.v.numpy() + added))
        moved = position(solver, tip) - tip
        yield solver, (-float(moved[2]) / L, -float(moved[0]) / L)


def tip_share(x: np.ndarray, tip: float, dx: float) -> np.ndarray:
    """[P] share of the load on each particle of the last cell, whose resultant is at the tip; 0 on others."""
    last = x > tip - dx
    arm = x[last] - x[last].mean()
    share = np.zeros(len(x))
    share[last] = (1.0 + (tip - x[last].mean()) / (arm**2).mean() * arm) / last.sum()
    return share
