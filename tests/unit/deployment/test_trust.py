"""Whether to believe a run: what it left that was taught, and what it says of its error."""

import json
from types import SimpleNamespace

import numpy as np
import pytest

from nsf.deployment import Band, Calibration, Reach, Trust, Usual
from nsf.errors import SchemaError
from nsf.mpm import Cuboid, Motion
from nsf.pipeline.stages.calibration import _tells
from nsf.recurrence import collider_states

T = np.linspace(0.0, 1.0, 6)
LATENTS = np.stack([T, np.zeros(6)], 1)  # from 0 to 1 m along the first
DOWN = np.tile([0.0, 0.0, -10.0], (5, 1))
UP, EAST = np.array([0.0, 0.3]), np.array([0.0, 1.0, 0.0])
NONE = np.zeros((5, 0))


def reach(**changed):
    values = {
        "names": ("E",),
        "box": np.array([[1.0, 3.0]]),
        "gravity": DOWN[0],
        "radius": 1.0,
        "solids": None,
        "states": Band.of_states(LATENTS, []),
    }
    return Reach(**values | changed)


def trust(*further, limit=0.2):
    return Trust(np.eye(2), LATENTS, limit, *further)


def calibrated(errors=(0.1,)):
    rows = np.array(errors)[:, None] * T
    calibration = Calibration.of(T, rows, np.tile(T, (len(rows), 1)), rows, np.tile(T, (len(rows), 1)))
    return trust(reach(), calibration, np.full((len(rows), 1), 2.0))


def test_members_tell_by_their_deviation_in_metres():
    members = np.stack([LATENTS + UP, LATENTS - UP])
    one = Trust(np.diag([1.0, 2.0]), LATENTS, 0.2)
    np.testing.assert_allclose(one.signal(LATENTS, members), 0.6 * np.sqrt(2.0))
    members[0, 3:] = np.nan
    assert np.isinf(one.signal(LATENTS, members)).tolist() == [False] * 3 + [True] * 3


def test_a_single_model_tells_by_its_distance_from_training_and_its_residual():
    off = LATENTS + UP
    np.testing.assert_allclose(trust().signal(off), 0.3)
    np.testing.assert_allclose(trust().signal(off, None, np.full(6, 0.4)), 0.5)
    off[2] = np.nan
    assert np.isinf(trust().signal(off)).tolist() == [False, False, True, False, False, False]


@pytest.mark.parametrize(
    ("values", "gravity", "why"),
    [
        (2.0, DOWN, ""),
        (3.0 + 1e-8, DOWN - [0.0, 0.0, 1.0], ""),
        (4.0, DOWN, "E=4 is outside of 1 … 3"),
        (2.0, DOWN + 1.5 * EAST, r"gravity is 1.5 m/s² from that which was taught, 1 m/s² at most"),
    ],
)
def test_inputs_outside_of_what_was_taught(values, gravity, why):
    assert reach().of_inputs({"E": values}, gravity, NONE, 0.1) == why


def test_another_scene_in_deployment_is_outside():
    assert "deploy.changes has material.nu" in reach(changed="material.nu").of_inputs(
        {"E": 2.0}, DOWN, NONE, 0.1
    )


def test_a_parameter_without_a_range_is_what_it_was():
    one = reach(box=np.array([[2.0, 2.0]]))
    assert one.of_inputs({"E": 2.0}, DOWN, NONE, 0.1) == ""
    assert one.of_inputs({"E": 2.1}, DOWN, NONE, 0.1) == "E=2.1 is outside of 2 … 2"


def plates(*depths):
    """States of plates that press so deep in 1 s."""
    moves = [Motion([0.0, 1.0], [[0.0] * 3, [0.0, 0.0, -depth]]) for depth in depths]
    return np.stack([collider_states([Cuboid([0.5] * 3, [0.1] * 3, motion=m)], 0.1, 10) for m in moves])


def test_solids_may_go_twice_as_far_beyond_as_one_training_run_goes_beyond_the_others():
    band = Band.of_solids(plates(0.1, 0.2), 0.1)
    assert band.leeway == pytest.approx(2.0 * 2.0)  # 0.2 is 0.1 beyond a range of 0 … 0.1
    one = reach(solids=band)
    assert [bool(one.of_inputs({"E": 2.0}, DOWN, plates(d)[0], 0.1)) for d in (0.15, 0.35, 0.45)] == [
        False,
        False,
        True,
    ]


def test_states_may_leave_those_of_training_twice_as_far_as_validation_runs_do():
    far = LATENTS + UP * 2 / 3  # of a range whose half is 0.5
    for others, outside in ((0.0, True), (0.5, False)):
        one = reach(states=Band.of_states(LATENTS, [LATENTS + others * UP]))
        assert one.of_states(far).all() == outside


def fallen(count, of=100):
    """Runs [R, 6, 2] whose states scatter by 0.01 m; some go 1 m aside, each its own way."""
    runs = np.tile(LATENTS, (of, 1, 1)) + np.random.default_rng(0).normal(0.0, 0.01, (of, 6, 2))
    angles = np.linspace(0.0, np.pi, count)
    for run, angle in zip(range(1, 2 * count, 2), angles, strict=True):
        runs[run] += T[:, None] * [np.cos(angle), 1.0 + np.sin(angle)]
    return runs


def test_a_run_is_usual_that_is_no_outlier_among_those_that_taught():
    usual, rare = Usual.of(fallen(1)), LATENTS + T[:, None] * [0.3, 0.7]
    assert 0.0 < usual.leeway < 0.1
    assert not usual.left(LATENTS, 1).any()
    assert usual.left(rare, 1).tolist() == [False] + [True] * 5
    one = reach(states=Band.of_states(fallen(1).reshape(-1, 2), []), usual=usual)
    assert one.of_states(rare).any()
    assert not reach(states=one.states).of_states(rare).any()
    assert Usual.of(fallen(40)).leeway > 0.1  # two of five runs fall: that is usual


def test_too_few_runs_say_nothing_of_what_is_usual():
    assert Usual.of(fallen(1)[:7]) is None
    assert Usual.of(fallen(1)[:8]) is not None


def test_frames_that_are_stored_now_and_then_are_looked_at_as_often():
    assert Usual.of(fallen(1), 5).every == 5 * Usual.of(fallen(1)).every


def test_a_run_within_what_was_taught_has_the_bound_of_validation():
    verdict = calibrated().judge({"E": 2.0}, T, LATENTS, 0.1 * T)
    assert verdict.bound_share == pytest.approx(calibrated().calibration.factor * 0.1)
    assert verdict.error_share == pytest.approx(0.1)
    assert (verdict.flag, verdict.beyond) == ("red", False)
    assert "coarse" in verdict.text


def test_a_bound_grows_away_from_the_validation_cases():
    near, far = (calibrated((0.01, 0.01)).judge({"E": E}, T, LATENTS, 0.0 * T) for E in (2.0, 3.0))
    assert far.bound_share == pytest.approx(1.25 * near.bound_share)
    assert near.flag == "green"


@pytest.mark.parametrize("error", [1e-4, 0.01])
def test_what_left_the_range_is_red_however_small_its_bound(error):
    one = calibrated((error, error))
    left = LATENTS + np.outer(T > 0.5, [0.0, 3.0])
    for run, outside, why in (
        (LATENTS, "E=9 is outside", "E=9"),
        (left, "", "left those of the training runs at t = 0.6 s"),
    ):
        verdict = one.judge({"E": 2.0}, T, run, 0.0 * T, outside)
        assert (verdict.flag, verdict.beyond) == ("red", True)
        assert why in verdict.text


def test_a_lost_run_is_red():
    one, lost = calibrated((0.01, 0.01)), LATENTS.copy()
    lost[4:] = np.nan
    verdict = one.judge({"E": 2.0}, T, lost, np.where(T > 0.7, np.inf, 0.0), diverged=4)
    assert (verdict.flag, verdict.bound_share) == ("red", np.inf)
    assert "diverged at t = 0.8 s" in verdict.text


def test_without_validation_runs_nothing_is_known():
    verdict = trust(reach()).judge({"E": 2.0}, T, LATENTS, 0.0 * T)
    assert verdict.text == "unknown: no validation run tells (set scene.design.validation)"
    assert trust(reach()).judge({"E": 2.0}, T, LATENTS, 0.0 * T, diverged=3).flag == "red"


def test_members_that_were_all_lost_at_validation_promise_nothing():
    gone = np.full((1, 6), np.inf)
    one = trust(
        reach(), Calibration.of(T, gone, np.ones((1, 6)), gone, np.ones((1, 6))), np.full((1, 1), 2.0)
    )
    verdict = one.judge({"E": 2.0}, T, LATENTS, 0.0 * T)
    assert verdict.flag == "red"
    assert "every validation run was lost" in verdict.text


def test_a_run_in_its_midst_counts_against_what_validation_runs_move():
    one = calibrated((0.1, 0.1))
    part = one.judge({"E": 2.0}, T[:2], LATENTS[:2], 0.1 * T[:2], whole=False)
    assert part.displacement == pytest.approx(one.calibration.displacement)
    assert part.bound_share < one.judge({"E": 2.0}, T, LATENTS, 0.1 * T).bound_share


class Trained:
    """Of a manifold what `Trust.open` reads."""

    latent_dim = 2

    class training_latents:
        double = cpu = staticmethod(lambda: Trained.training_latents)
        numpy = staticmethod(lambda: LATENTS)


def test_round_trip(tmp_path):
    one = calibrated((0.1, 0.2))
    one.save(tmp_path / "trust.json")
    other = Trust.open(tmp_path / "trust.json", Trained)
    runs = [t.judge({"E": 2.5}, T, LATENTS, 0.3 * T) for t in (one, other)]
    np.testing.assert_allclose(runs[0].bound, runs[1].bound)


@pytest.mark.parametrize(
    "change", [{"metric": [[1.0]]}, {"limit": "much"}, {"reach": {}}, {"calibration": {"t": []}}]
)
def test_what_is_no_trust_file(tmp_path, change):
    (tmp_path / "trust.json").write_text(json.dumps(calibrated().plain | change))
    with pytest.raises(SchemaError, match="deploy again"):
        Trust.open(tmp_path / "trust.json", Trained)


def test_a_lost_validation_run_widens_no_range():
    lost = LATENTS.copy()
    lost[-1] = np.nan
    assert Band.of_states(LATENTS, [lost]).leeway == Band.of_states(LATENTS, []).leeway


def test_a_validation_run_that_left_what_was_taught_calibrates_nothing():
    usual = Usual.of(fallen(1))
    one = reach(states=Band.of_states(fallen(1).reshape(-1, 2), []), usual=usual)
    rare = LATENTS + T[:, None] * [0.3, 0.7]
    counts = [
        _tells(SimpleNamespace(xhat=xhat, diverged=diverged), one, trust())
        for xhat, diverged in ((LATENTS, -1), (rare, -1), (rare, 3))
    ]
    assert counts == [True, False, True]  # one that diverged counts, as lost
