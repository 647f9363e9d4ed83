"""Mirror planes of a scene: their images, what is refused, and what a lesson becomes in them."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import nsf
from nsf import config
from nsf.engines.operators import Mirrored, collider_states, mirrored_states
from nsf.errors import ConfigError
from nsf.mpm import Motion
from nsf.pipeline import Pipeline
from nsf.pipeline.stages.teaching import mirror
from nsf.scenes import Symmetry

X, Y, Z, DIAGONAL = [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, -1, 0]
#: Scene, centre of its planes, and their normals.
OWN = {
    "block": ((0.4, 0.4, 0.17), (X, Y, DIAGONAL)),
    "tray": ((0.22, 0.22, 0.11), (X, Y, DIAGONAL)),
    "press": ((0.5, 0.5, 0.5), (X, Y, Z)),
}


def scene(name, *overrides):
    return nsf.load_scene(name, ["scale=small", *overrides])


@pytest.mark.parametrize(
    ("mirrors", "images"),
    [([], 1), ([X], 2), ([X, Y], 4), ([X, Y, DIAGONAL], 8), ([X, DIAGONAL, [0, 1, -1]], 48)],
)
def test_reflections_make_a_group(mirrors, images):
    group = Symmetry((0.0, 0.0, 0.0), mirrors).group()
    assert len(group) == images
    np.testing.assert_array_equal(group[0], np.eye(3))
    for R in group:
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
        for other in group:
            assert any(np.allclose(R @ other, known) for known in group)


@pytest.mark.parametrize("name", OWN)
def test_a_scene_s_own_planes(name):
    """They are those of its yaml, and solids go over into equal ones."""
    centre, mirrors = OWN[name]
    own = scene(name)
    declared = config.load([f"scene={name}", "scale=small"]).reduction.symmetry
    assert (tuple(declared.centre), [list(n) for n in declared.mirrors]) == (
        centre,
        [list(n) for n in mirrors],
    )
    images = Symmetry(centre, mirrors).images(own)
    assert len(images) == 8
    x = np.random.default_rng(1).random((50, 3)) * np.asarray(own.size)
    for image in images:
        assert sorted(image.partners) == list(range(len(own.solids)))
        for collider, partner in zip(own.solids, image.partners, strict=True):
            there = replace(own.solids[partner], motion=None).distance(
                Symmetry(centre, mirrors).at(x, image.R)
            )
            np.testing.assert_allclose(there, replace(collider, motion=None).distance(x), atol=1e-9)


def test_states_of_an_image_are_those_of_solids_that_move_as_it_does():
    symmetry, own = Symmetry(*OWN["press"]), scene("press", "scene.program=3")
    states = collider_states(own.solids, own.dt, own.steps)
    assert np.ptp(states, axis=0).max() > 0.01
    for image in symmetry.images(own):
        moved = [None, None]
        for collider, partner in zip(own.solids, image.partners, strict=True):
            times, shifts, _ = collider.motion.keyframes()
            turned = Motion(times.tolist(), (shifts @ image.R.T).tolist())
            moved[partner] = replace(
                own.solids[partner], motion=turned, since=collider.since, until=collider.until
            )
        expected = collider_states(moved, own.dt, own.steps)
        np.testing.assert_allclose(mirrored_states(states, image), expected, atol=1e-15)


@pytest.mark.parametrize(
    ("name", "centre", "mirrors", "overrides", "told"),
    [
        ("block", (0.4, 0.4, 0.17), [Z], [], "the domain"),
        (
            "block",
            (0.4, 0.4, 0.17),
            [X],
            ["scene.bodies.block.shape.lower=[0.33,0.34,0.08]"],
            "body block (Box)",
        ),
        ("block", (0.4, 0.4, 0.17), [X], ["scene.bodies.block.velocity=[0.1,0.0,0.0]"], "velocity"),
        ("tray", (0.22, 0.22, 0.11), [X], ["scene.colliders.west.point=[0.1,0.0,0.0]"], "half-space"),
        ("tray", (0.22, 0.22, 0.11), [X], ["scene.colliders.west.friction=0.2"], "half-space"),
    ],
)
def test_what_is_not_its_own_image_is_refused(name, centre, mirrors, overrides, told):
    with pytest.raises(ConfigError, match="not its own mirror image; leave out that plane") as refusal:
        Symmetry(centre, mirrors).images(scene(name, *overrides))
    assert told in str(refusal.value)


def test_a_solid_that_turns_is_refused():
    own = scene("press")
    motion = Motion([0.0, 1.0], angles=[0.0, 10.0], axis=[0, 1, 0], pivot=[0.5, 0.5, 0.5])
    turning = [replace(own.solids[0], motion=motion), own.solids[1]]
    with pytest.raises(ConfigError, match="the cuboid, which turns, is not its own mirror image"):
        Symmetry((0.5, 0.5, 0.5), [X]).images(
            SimpleNamespace(size=own.size, bodies=own.bodies, solids=turning)
        )


def test_planes_at_an_odd_angle_are_refused():
    with pytest.raises(ConfigError, match="more than 48 images"):
        Symmetry((0.0, 0.0, 0.0), [X, [1.0, 0.3, 0.0]])


class Lesson:
    """Two runs whose latent vector is a point, without solids."""

    dt, total_steps = 0.1, 2
    gravity, features = torch.randn(2, 2, 3).double(), torch.zeros(2, 2, 0).double()
    parameters, start = torch.tensor([[1.0], [2.0]]).double(), torch.randn(2, 3).double()

    def run(self):
        return torch.stack([self.start, 2.0 * self.start, 3.0 * self.start])

    def first_change(self):
        return 0.5 * self.start


def test_a_lesson_and_its_images():
    images = Symmetry((0.4, 0.4, 0.17), [X, DIAGONAL]).images(scene("block"))
    images = [replace(image, partners=()) for image in images]
    lesson = Lesson()
    found = Mirrored(lesson, images, lambda xhat, image: xhat @ torch.as_tensor(image.R).T)
    assert len(found) == 2 * len(images) == 16
    for k, image in enumerate(images):
        own, R = slice(2 * k, 2 * k + 2), torch.as_tensor(image.R)
        torch.testing.assert_close(found.run()[:, own], lesson.run() @ R.T)
        torch.testing.assert_close(found.first_change()[own], lesson.first_change() @ R.T)
        torch.testing.assert_close(found.gravity[:, own], lesson.gravity @ R.T)
        torch.testing.assert_close(found.parameters[own], lesson.parameters)
    assert not found.asked


def test_planes_that_the_scene_has_not_are_refused_before_any_work():
    wrong = ["scene=block", "scale=small", "model=recurrence", "reduction.symmetry.mirrors=[[0,0,1]]"]
    with pytest.raises(ConfigError, match="symmetry"):
        Pipeline(config.load(wrong)).check()


class Shifts:
    """A manifold whose latent vector is a shift of the body along x and y [m]."""

    X = torch.rand(30, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)

    def restrict(self, X, device):
        shift = torch.eye(2, 3, dtype=torch.float64)
        points = torch.as_tensor(X)
        return SimpleNamespace(device="cpu", position=lambda xhat: points + (xhat @ shift)[:, None])

    def encode(self, x):
        return (x - self.X).mean(1)[:, :2]


def test_a_shift_seen_in_mirrors():
    symmetry = Symmetry((0.4, 0.1, 0.0), [X, DIAGONAL])
    seen, xhat = mirror(Shifts(), symmetry), torch.tensor([[[0.3, 0.2]], [[-0.1, 0.5]]]).double()
    found = [seen(xhat, SimpleNamespace(R=R)) for R in symmetry.group()]
    for R, shifts in zip(symmetry.group(), found, strict=True):
        turned = xhat @ torch.as_tensor(R[:2, :2]).T
        torch.testing.assert_close(shifts, turned)
    assert len({tuple(shifts.flatten().round(decimals=6).tolist()) for shifts in found}) == 8
