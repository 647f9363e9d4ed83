"""The estimate of whether to believe a reduced run."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch

from nsf.deployment import Trust, calibrate, rollout
from nsf.deployment.rollout import _whole_step_before
from nsf.deployment.trust import QUANTILE, STRAY, LatentDistance, training_values
from nsf.dynamics import Taylor
from nsf.kinematics.manifold import Manifold


class Line:
    """A manifold whose two particles move along x by the first latent and a hundredth of the second."""

    X = torch.zeros(2, 3, dtype=torch.float64)
    points, dtype, device = 2, torch.float64, torch.device("cpu")

    def __init__(self, latents, trajectories):
        self.training_latents = torch.tensor(latents, dtype=torch.float64)
        self.training_trajectories = torch.tensor(trajectories)

    def restrict(self, particles, device):
        return self

    def position(self, xhat):
        x = torch.zeros(len(xhat), 2, 3, dtype=torch.float64)
        x[:, :, 0] = (xhat[:, 0] + 0.01 * xhat[:, 1])[:, None]
        return x


TWO = Line([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0], [0.0, 0.0], [1.5, 0.0], [4.0, 0.0]], [0, 0, 0, 1, 1, 1])
ALONE = Line([[0.0, 0.0], [1.0, 0.0]], [0, 0])


def distance(manifold):
    return LatentDistance(manifold, np.arange(2))


def test_distance_is_that_of_the_particles():
    found = distance(TWO).of(np.array([[1.0, 0.0], [1.2, 0.0], [4.0, 10.0], [-3.0, 0.0]]))
    np.testing.assert_allclose(found, [0.0, 0.2, 0.1, 3.0], atol=1e-7)


def test_distance_between_trajectories():
    np.testing.assert_allclose(distance(TWO).between_trajectories(), [0, 0.5, 0.5, 0, 0.5, 2.0], atol=1e-7)
    assert distance(ALONE).between_trajectories().shape == (0,)


def runs(largest, drift=0.1):
    """Calibration runs at the first training latents that leave these residuals at most."""
    return [(np.array([[0.0, 0.0], [drift, 0.0]]), np.array([0.5 * r, r])) for r in largest]


def test_scales():
    between = np.quantile([0, 0.5, 0.5, 0, 0.5, 2.0], QUANTILE)
    trust = Trust.calibrated(distance(TWO), runs([1.0, 1.5, 1.2]))
    assert (trust.residual, trust.distance) == pytest.approx((1.5, between))
    assert Trust.calibrated(distance(TWO), runs([1.0, 50.0, 1.2])).residual == pytest.approx(STRAY * 1.2)
    # Where trajectories are nearer to each other than runs stay to their own, or there is one alone.
    assert Trust.calibrated(distance(ALONE), runs([1.0], drift=-7.0)).distance == pytest.approx(7.0)
    assert Trust.calibrated(distance(TWO), runs([1.0], drift=-7.0)).distance == pytest.approx(7.0)


def test_ratios():
    trust = Trust(residual=2.0, distance=0.5, latent_distance=distance(TWO))
    xhat = np.array([[0.0, 0.0], [1.0, 0.0], [4.5, 0.0], [np.nan, 0.0], [0.0, 0.0]])
    found = trust.ratios(xhat, np.array([1.0, 0.2, 0.0, np.inf]))
    np.testing.assert_allclose(found, [0.0, 0.5, 1.0, np.inf, np.inf], atol=1e-6)


def test_runs_without_a_residual_calibrate_nothing():
    """As if all had diverged at once: then any residual is out of bounds."""
    trust = Trust.calibrated(distance(TWO), [(np.zeros((1, 2)), np.zeros(0))])
    found = trust.ratios(np.zeros((3, 2)), np.array([0.0, 1e-12]))
    assert found[1] == 0.0
    assert found[2] > 1.0


def test_training_trajectories(tiny_manifold):
    np.testing.assert_array_equal(tiny_manifold.training_trajectories, np.repeat([0, 1, 2], 25))


def test_calibration_values(tiny_manifold):
    assert training_values(tiny_manifold) == [22.0, 30.0, 38.0]
    alone = type("Alone", (), {"training_parameters": torch.full((5, 1), 0.2, dtype=torch.float32)})
    assert training_values(alone) == [0.2]


@pytest.fixture(scope="module")
def build(pipeline_at, tmp_path_factory):
    """value, device → solver; a longer and better trained tiny chain, on which angles make a difference."""
    longer = ("scene.steps=40", "trainer.steps=2000")
    pipeline = pipeline_at(tmp_path_factory.mktemp("trust"), *longer, "scene.parameters.test=[]")
    pipeline.simulate()
    pipeline.train()
    manifold = Manifold.load(pipeline.training.path / "manifold.pt")
    return partial(pipeline.solver_at, manifold)


@pytest.fixture(scope="module")
def trust(build):
    return calibrate(build, build.args[0], "cpu")


@pytest.fixture(scope="module")
def run_at(build, trust):
    return lambda value, **options: rollout(build(value, "cpu"), value, trust, **options)


def test_training_values_are_believed_and_far_ones_not(run_at):
    for value in (22.0, 30.0, 38.0):
        assert run_at(value).trust.max() < 1.5
    inside = run_at(27.0)
    assert inside.trust.max() <= 1.0
    assert inside.distrusted == inside.handed_over == -1
    assert inside.trust[0] < 1e-3  # the start is in every trajectory
    far = run_at(70.0)
    assert far.trust.max() > 2.0
    assert 0 < far.distrusted < 40
    assert far.trust[: far.distrusted].max() <= 1.0 < far.trust[far.distrusted]


def test_a_diverged_calibration_run_is_cut(chain, tiny_manifold, tiny_trust):
    """What follows a divergence is no measure of anything."""

    class Thrown(Taylor):
        def __init__(self):
            object.__setattr__(self, "calls", [0])

        def solve(self, at, target, xhat, weights=None):
            self.calls[0] += 1
            result = super().solve(at, target, xhat)
            far = 1e4 if self.calls[0] == 12 else 0.0
            return replace(result, xhat=result.xhat + far, residuals=result.residuals + far)

    def solver_at(value, device):
        options = {"projector": Thrown(), "sample": 20, "device": device}
        return chain.scene.reduced(tiny_manifold, {"friction_angle": value}, **options)

    trust = calibrate(solver_at, tiny_manifold, "cpu")
    assert 0.0 < trust.residual < 1.0
    assert trust.distance == pytest.approx(tiny_trust.distance, rel=0.5)


def test_a_run_to_be_handed_over_stops_at_the_first_distrusted_step(run_at):
    whole, stopped = run_at(70.0), run_at(70.0, until_distrusted=True)
    n = whole.distrusted
    assert (stopped.distrusted, stopped.handed_over) == (n, n - 1)
    assert len(stopped.residuals) == len(stopped.stops) == n
    for name in ("t", "xhat", "trust"):
        np.testing.assert_array_equal(getattr(stopped, name), getattr(whole, name)[: n + 1])
    believed = run_at(27.0, until_distrusted=True)
    assert believed.handed_over == -1
    np.testing.assert_array_equal(believed.xhat, run_at(27.0).xhat)


@pytest.mark.parametrize(
    ("multiplier", "step", "expected"),
    [(1.0, 9, 8), (1.0, 1, 0), (1.0, 0, 0), (1.5, 9, 8), (1.5, 8, 6), (4.0 / 3.0, 9, 6), (np.pi / 2.0, 9, 0)],
)
def test_the_hand_over_is_at_a_full_order_frame(multiplier, step, expected):
    """The last step n < `step` for which n times the multiplier is whole; else the start."""
    assert _whole_step_before(0.004 * multiplier * np.arange(20), step, 0.004) == expected
