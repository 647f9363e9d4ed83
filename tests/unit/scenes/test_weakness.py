"""Weak elements: how many, which, how weak."""

import re

import numpy as np
import pytest

from nsf import load_scene
from nsf.errors import ConfigError
from nsf.scenes import Box, Weakness

LOAF = Box((0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
MIDDLE = Box((0.4, 0.0, 0.0), (0.6, 1.0, 1.0))


@pytest.fixture(scope="module")
def X():
    return LOAF.sample(5000)


def weak(X, **options):
    return np.flatnonzero(Weakness(MIDDLE, **options).of(X) < 1.0)


def test_a_share_of_the_region_is_weaker_by_the_factor(X):
    stiffness = Weakness(MIDDLE, factor=0.25, share=0.4).of(X)
    inside = MIDDLE.contains(X)
    assert set(stiffness) == {0.25, 1.0}
    assert (stiffness[~inside] == 1.0).all()
    assert (stiffness[inside] == 0.25).sum() == round(0.4 * inside.sum())


def test_whole_region(X):
    np.testing.assert_array_equal(weak(X, share=1.0), np.flatnonzero(MIDDLE.contains(X)))


def test_drawn_at_random_over_the_region(X):
    """Not the first ones, and on both sides: its two halves differ by a few standard deviations at most."""
    chosen = X[weak(X, share=0.3)]
    left = (chosen[:, 0] < 0.5).sum()
    assert abs(left - 0.5 * len(chosen)) < 4 * (0.25 * len(chosen)) ** 0.5


def test_the_seed_alone_decides(X):
    np.random.seed(1)  # noqa: NPY002
    first = weak(X, seed=3)
    np.random.default_rng(3).random(7)
    np.random.seed(2)  # noqa: NPY002
    np.testing.assert_array_equal(first, weak(X, seed=3))
    assert len(np.intersect1d(first, weak(X, seed=4))) < 0.5 * len(first)


def test_factor_does_not_change_the_draw(X):
    np.testing.assert_array_equal(weak(X, factor=0.1), weak(X, factor=0.9))


class TestPerturbation:
    @pytest.mark.parametrize("scale", [0.08, 0.3])
    def test_exchanges_that_share(self, X, scale):
        before, after = weak(X), weak(X, perturbation=scale)
        assert len(before) == len(after)
        assert len(np.setdiff1d(after, before)) == round(scale * len(before))
        assert MIDDLE.contains(X[after]).all()

    def test_a_larger_one_includes_a_smaller(self, X):
        before, mild, strong = weak(X), weak(X, perturbation=0.08), weak(X, perturbation=0.3)
        assert np.isin(np.setdiff1d(mild, before), strong).all()
        assert not np.isin(np.setdiff1d(before, mild), strong).any()

    def test_none(self, X):
        np.testing.assert_array_equal(weak(X), weak(X, perturbation=0.0))

    def test_all_that_are_left(self, X):
        assert not np.isin(weak(X, share=0.5, perturbation=1.0), weak(X, share=0.5)).any()

    def test_a_region_nearly_all_weak_takes_others_of_the_body(self, X):
        """Bread: nine in ten are weak, and 30 % are exchanged."""
        before, after = weak(X, share=0.9), weak(X, share=0.9, perturbation=0.3)
        region = MIDDLE.contains(X).sum()
        assert len(before) == len(after)
        assert len(np.setdiff1d(after, before)) == round(0.3 * len(before))
        assert (~MIDDLE.contains(X[after])).sum() == round(0.3 * len(before)) - (region - len(before)) > 0

    def test_a_body_too_small_to_exchange(self, X):
        few = X[MIDDLE.contains(X)]
        with pytest.raises(ConfigError, match=r"weakness\.perturbation=0\.5 exchanges .* lower it"):
            Weakness(MIDDLE, share=0.9, perturbation=0.5).of(few)


@pytest.mark.parametrize(
    ("options", "quoted"),
    [
        ({"factor": 0.0}, "weakness.factor=0.0"),
        ({"factor": 1.5}, "weakness.factor=1.5"),
        ({"factor": float("nan")}, "weakness.factor=nan"),
        ({"share": 0.0}, "weakness.share=0.0"),
        ({"share": 1.1}, "weakness.share=1.1"),
        ({"share": "some"}, "weakness.share=some"),
        ({"seed": -1}, "weakness.seed=-1"),
        ({"seed": 0.5}, "weakness.seed=0.5"),
        ({"perturbation": -0.1}, "weakness.perturbation=-0.1"),
        ({"perturbation": 1.2}, "weakness.perturbation=1.2"),
    ],
)
def test_refused(options, quoted):
    with pytest.raises(ConfigError, match=re.escape(quoted)):
        Weakness(MIDDLE, **options)


def test_a_region_without_particles(X):
    with pytest.raises(ConfigError, match="of the 0 particles in its region"):
        Weakness(Box((2.0, 2.0, 2.0), (3.0, 3.0, 3.0))).of(X)


def test_in_a_scene():
    """μ̂ and λ of the weak particles, and of no other property or body."""
    body = "{_target_: nsf.scenes.Weakness, factor: 0.2, share: 0.5, region: {_target_: nsf.scenes.Box, lower: [0,0,0], upper: [0.5,1,1]}}"  # fmt: skip # noqa: E501
    few = "scene.bodies.column.particles=300"
    plain, scene = (
        load_scene("sand", [few]),
        load_scene("sand", [few, f"+scene.bodies.column.weakness={body}"]),
    )
    before, after = plain.particles(), scene.particles()
    for name in ("X", "mass", "volume0"):
        np.testing.assert_array_equal(getattr(after, name), getattr(before, name))
    factor = next(iter(scene.bodies.values())).weakness.of(before.X)
    assert (factor == 0.2).sum() == round(0.5 * (before.X[:, 0] <= 0.5).sum()) > 50
    np.testing.assert_array_equal(after.mu, factor * before.mu)
    np.testing.assert_array_equal(after.lam, factor * before.lam)
    solver = scene.full_order(device="cpu")
    rows = solver.state.order.numpy()
    np.testing.assert_array_equal(solver.mu.numpy(), after.mu[rows])
    np.testing.assert_array_equal(solver.lam.numpy(), after.lam[rows])
