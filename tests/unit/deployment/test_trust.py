"""The estimate of whether to believe a reduced run."""

from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from angles import AnyCase, angle, rollout

import nsf
from nsf.deployment import Trust, calibrate
from nsf.deployment.fallback import full_order_step
from nsf.deployment.trust import QUANTILE, STRAY, CaseDistance, LatentDistance, SolidsRange
from nsf.dynamics import Taylor
from nsf.kinematics.manifold import Manifold
from nsf.mpm import Cuboid, Motion
from nsf.recurrence import collider_states


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
    trust = Trust.calibrated(distance(TWO), AnyCase(), runs([1.0, 1.5, 1.2]))
    assert (trust.residual, trust.distance) == pytest.approx((1.5, between))
    assert Trust.calibrated(distance(TWO), AnyCase(), runs([1.0, 50.0, 1.2])).residual == pytest.approx(
        STRAY * 1.2
    )
    # Where trajectories are nearer to each other than runs stay to their own, or there is one alone.
    assert Trust.calibrated(distance(ALONE), AnyCase(), runs([1.0], drift=-7.0)).distance == pytest.approx(
        7.0
    )
    assert Trust.calibrated(distance(TWO), AnyCase(), runs([1.0], drift=-7.0)).distance == pytest.approx(7.0)


def test_ratios():
    trust = Trust(residual=2.0, distance=0.5, latent_distance=distance(TWO), cases=AnyCase())
    xhat = np.array([[0.0, 0.0], [1.0, 0.0], [4.5, 0.0], [np.nan, 0.0], [0.0, 0.0]])
    found = trust.ratios(xhat, np.array([1.0, 0.2, 0.0, np.inf]))
    np.testing.assert_allclose(found, [0.0, 0.5, 1.0, np.inf, np.inf], atol=1e-6)


def test_runs_without_a_residual_calibrate_nothing():
    """As if all had diverged at once: then any residual is out of bounds."""
    trust = Trust.calibrated(distance(TWO), AnyCase(), [(np.zeros((1, 2)), np.zeros(0))])
    found = trust.ratios(np.zeros((3, 2)), np.array([0.0, 1e-12]))
    assert found[1] == 0.0
    assert found[2] > 1.0


def test_training_trajectories(tiny_manifold):
    np.testing.assert_array_equal(tiny_manifold.training_trajectories, np.repeat([0, 1, 2], 25))


def cases_of(*rows, names=("a", "b")):
    """Distance from training cases of two frames each."""
    parameters = torch.tensor(rows, dtype=torch.float64).repeat_interleave(2, 0)
    return CaseDistance(
        SimpleNamespace(parameter_names=names[: len(rows[0])], training_parameters=parameters)
    )


def test_calibration_cases(tiny_manifold):
    angles = [{"friction_angle": value} for value in (22.0, 30.0, 38.0)]
    assert CaseDistance(tiny_manifold).extremes() == angles
    assert cases_of([0.2]).extremes() == [{"a": 0.2}]
    rows = [[0.0, 5.0], [1.0, 9.0], [2.0, 6.0], [3.0, 7.0], [4.0, 8.0]]  # first, middle and last along each
    assert [tuple(case.values()) for case in cases_of(*rows).extremes()] == [tuple(row) for row in rows]
    assert len(cases_of(*rows, [2.5, 6.5]).extremes()) == 5


def test_a_case_between_the_training_values_of_one_parameter_is_near():
    """Also in the widest gap, and at the ends."""
    found = cases_of([0.1], [0.2], [0.3], [0.9])
    assert [found.of({"a": value}) for value in (0.1, 0.9)] == [0.0, 0.0]
    assert found.of({"a": 0.6}) == pytest.approx(0.5)
    assert max(found.of({"a": value}) for value in np.linspace(0.1, 0.9, 81)) <= 0.5 + 1e-9


def test_a_case_outside_of_the_box_of_training_is_far():
    found = cases_of([0.0], [1.0], [3.0])  # the spacing is 2
    assert found.of({"a": 3.001}) == pytest.approx(1.0005)
    assert found.of({"a": -2.0}) == pytest.approx(2.0)
    corners = cases_of([0, 0], [0, 10], [1, 0], [1, 10])  # standardised, both edges are 2
    assert corners.of({"a": 0.5, "b": 5.0}) == pytest.approx(np.sqrt(2.0) / 2.0)
    assert corners.of({"b": 5.0, "a": 1.5}) == pytest.approx(1.5)
    assert corners.of({"a": 2.0, "b": 20.0}) == pytest.approx(1.0 + np.sqrt(2.0))


def test_a_hole_among_the_training_cases_of_two_parameters_is_far():
    rim = [[np.cos(a), np.sin(a)] for a in np.linspace(0, 2 * np.pi, 12, endpoint=False)]
    assert cases_of(*rim).of({"a": 0.0, "b": 0.0}) > 1.9
    assert cases_of(*rim, [0.0, 0.0]).of({"a": 0.0, "b": 0.0}) == 0.0


def test_one_training_case_is_near_itself_alone():
    assert cases_of([0.2, 7.0]).of({"a": 0.2, "b": 7.0}) == 0.0
    assert 1.0 < cases_of([0.2, 7.0]).of({"a": 0.2, "b": 7.1}) < np.inf


@pytest.fixture(scope="module")
def build(pipeline_at, tmp_path_factory):
    """case, device → solver; a longer and better trained tiny chain, on which angles make a difference."""
    longer = ("scene.steps=40", "trainer.steps=2000")
    pipeline = pipeline_at(tmp_path_factory.mktemp("trust"), *longer, "scene.design.test=[]")
    pipeline.simulate()
    pipeline.train()
    manifold = Manifold.load(pipeline.training.path / "manifold.pt")
    return partial(pipeline.solver_at, manifold)


@pytest.fixture(scope="module")
def trust(build):
    return calibrate(build, build.args[0], "cpu")


@pytest.fixture(scope="module")
def run_at(build, trust):
    """value → its run, of which the steps alone tell whether to believe it."""
    of_steps = replace(trust, cases=AnyCase())
    return lambda value, **options: rollout(build(angle(value), "cpu"), angle(value), of_steps, **options)


def test_a_run_far_from_the_training_cases_is_distrusted_from_the_start(build, trust, run_at):
    far = rollout(build(angle(40.0), "cpu"), angle(40.0), trust, to="full")
    assert far.away == pytest.approx(1.25)  # the training cases are 8° apart
    assert (far.distrusted, far.handed_over) == (0, 0)
    inside = rollout(build(angle(27.0), "cpu"), angle(27.0), trust)
    assert inside.away == pytest.approx(3.0 / 8.0)
    np.testing.assert_array_equal(inside.trust, run_at(27.0).trust)  # below 1 it says nothing


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

    def solver_at(case, device):
        options = {"projector": Thrown(), "sample": 20, "device": device}
        return nsf.reduced(chain.scene, tiny_manifold, case, **options)

    trust = calibrate(solver_at, tiny_manifold, "cpu")
    assert 0.0 < trust.residual < 1.0
    assert trust.distance == pytest.approx(tiny_trust.distance, rel=0.5)


def test_a_run_to_be_handed_over_stops_at_the_first_distrusted_step(run_at):
    whole, stopped = run_at(70.0), run_at(70.0, to="full")
    n = whole.distrusted
    assert (stopped.distrusted, stopped.handed_over) == (n, n - 1)
    assert len(stopped.residuals) == len(stopped.stops) == n
    for name in ("t", "xhat", "trust"):
        np.testing.assert_array_equal(getattr(stopped, name), getattr(whole, name)[: n + 1])
    believed = run_at(27.0, to="full")
    assert believed.handed_over == -1
    np.testing.assert_array_equal(believed.xhat, run_at(27.0).xhat)


@pytest.mark.parametrize(
    ("multiplier", "step", "expected"),
    [(1.0, 9, 8), (1.0, 1, 0), (1.0, 0, 0), (1.5, 9, 8), (1.5, 8, 6), (4.0 / 3.0, 9, 6), (np.pi / 2.0, 9, 0)],
)
def test_the_hand_over_is_at_a_full_order_frame(multiplier, step, expected):
    """The last step n < `step` for which n times the multiplier is whole; else the start."""
    assert full_order_step(0.004 * multiplier * np.arange(20), step, 0.004) == expected


# -- solids that programs move ---------------------------------------------------------------------------


def pressed(depth, stroke=0.1, aside=0.0, dt=0.01):
    """States of a plate that presses and stops."""
    motion = Motion([0.0, stroke], [[aside, 0.0, 0.0], [aside, 0.0, depth]])
    plate = Cuboid((0.5, 0.5, 0.3), (0.1, 0.1, 0.1), "separate", motion=motion)
    return collider_states([plate], dt, round(0.2 / dt))


@pytest.fixture(scope="module")
def plates():
    """What plates did in training: depths from 10 to 50 mm, speeds from 0.1 to 0.5 m/s, 5 mm aside."""
    runs = [
        pressed(d, aside=a)
        for d, a in ((0.01, -5e-3), (0.02, 5e-3), (0.04, 0.0), (0.05, 4e-3), (0.05, -5e-3))
    ]
    return SolidsRange(np.stack(runs), 0.01)


def test_solids_that_move_as_in_training_are_believed(plates):
    assert plates.of(pressed(0.03, aside=2e-3), 0.01).max() <= 1.0
    assert plates.of(pressed(0.03, aside=2e-3, dt=0.004), 0.004).max() <= 1.0
    assert plates.of(pressed(0.05, aside=-5e-3), 0.01).shape == (20,)


@pytest.mark.parametrize(
    "other",
    [pressed(0.08, stroke=0.16), pressed(0.04, stroke=0.04), pressed(-0.02), pressed(0.03, aside=0.02)],
    ids=["deeper", "faster", "backwards", "further aside"],
)  # fmt: skip
def test_solids_that_go_where_none_was_are_distrusted(plates, other):
    assert plates.of(other, 0.01).max() > 1.0


def test_a_solid_that_never_turned_may_not_turn(plates):
    motion = Motion([0.0, 0.1], [[0.0] * 3, [0.0, 0.0, 0.03]], [0.0, 5.0], [0, 0, 1], [0.5, 0.5, 0.3])
    plate = Cuboid((0.5, 0.5, 0.3), (0.1, 0.1, 0.1), "separate", motion=motion)
    assert plates.of(collider_states([plate], 0.01, 20), 0.01).max() == np.inf


def test_what_forces_a_run_counts_only_outside(plates, tiny_trust):
    trust = replace(tiny_trust, solids=plates)
    gravity = np.zeros((20, 3))
    np.testing.assert_array_equal(trust.of_forcing(gravity, pressed(0.03), 0.01), 0.0)
    assert trust.of_forcing(gravity, pressed(0.04, stroke=0.04), 0.01)[:4].min() > 1.0
