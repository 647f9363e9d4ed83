"""Bread tears at its weak elements, at every stiffness (paper section 6.1)."""

import numpy as np
import pytest

import nsf


def connected(x, start, reach):
    """[P] which of x [P, 3] a chain of particles, each within reach [m] of the next, joins to `start` [P]."""
    reached, frontier = start.copy(), np.flatnonzero(start)
    while len(frontier):
        rest = np.flatnonzero(~reached)
        near = np.zeros(len(rest), bool)
        for part in np.array_split(frontier, -(-len(frontier) // 200)):
            near |= (((x[rest, None] - x[part]) ** 2).sum(-1) <= reach**2).any(1)
        frontier = rest[near]
        reached[frontier] = True
    return reached


def torn(value, overrides=()):
    """Is no particle of one grip joined to the other's by particles within 2 Δx of each other?"""
    scene = nsf.load_scene("bread", ["scale=small", *overrides])
    solver = scene.full_order({"E": value}, device="cpu")
    solver.step(scene.steps)
    X, x = scene.particles().X, solver.state.numpy()["x"]
    left, right = X[:, 0] < 0.425, X[:, 0] > 0.575
    joined = connected(x, left, 2.0 * scene.dx)
    # Where it tore, the fracture runs through the weak elements: the rest keeps to its grip.
    weak = next(iter(scene.bodies.values())).weakness.region.contains(X)
    return not (joined & right).any() and np.array_equal(joined[~weak], X[~weak, 0] < 0.5)


@pytest.mark.parametrize("E", [1.0, 13.0])
def test_bread_tears_at_its_weak_elements(E):
    assert torn(E)


@pytest.mark.parametrize(
    "overrides",
    [
        ["scene.bodies.slice.weakness.factor=1.0"],
        [f"scene.colliders.{grip}.motion.translations=[[0,0,0],[0,0,0]]" for grip in ("left", "right")],
    ],
    ids=["no weak elements", "no pull"],
)
def test_bread_does_not_tear_without(overrides):
    assert not torn(4.17, overrides)
