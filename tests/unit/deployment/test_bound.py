"""The bound of an error, from runs of validation cases: closed forms, and its promise."""

import json

import numpy as np
import pytest

from nsf.deployment.bound import ENOUGH, SCATTER, Calibration, factor_of, flag_of, rms, widening

T = np.linspace(0.0, 1.0, 5)
RAMP = T / rms(T)


def calibration(shares, signals, displacement=2.0, shape=RAMP, floor=0.5):
    """Of runs whose errors are shares of one displacement."""
    with np.errstate(invalid="ignore"):
        errors, signals = (np.outer(values, shape) for values in (displacement * np.array(shares), signals))
    moved = np.full(errors.shape, displacement)
    return Calibration.of(T, errors, moved, signals, moved, floor)


def test_one_score_is_widened_by_the_quantile_of_a_difference():
    """log(e/e_1) of two log-normal errors has √2 times their deviation, and 1.2816 of it as 90 % quantile."""
    assert widening(1) == pytest.approx(np.exp(1.2816 * np.sqrt(2.0) * SCATTER), rel=1e-3)
    assert ENOUGH == 9
    assert [widening(n) for n in (ENOUGH, 50)] == [1.0, 1.0]
    assert list(np.argsort([-widening(n) for n in range(1, ENOUGH)])) == list(range(ENOUGH - 1))


@pytest.mark.parametrize("runs", [1, 2, 4, 9, 30])
def test_a_factor_holds_in_nine_of_ten_cases(runs):
    rng = np.random.default_rng(runs)
    scores = np.exp(SCATTER * rng.standard_normal((2000, runs + 1)))
    held = np.mean([new <= factor_of(seen) for *seen, new in scores])
    assert 0.87 <= held <= 0.93


def test_many_scores_need_no_assumption():
    rng = np.random.default_rng(0)
    scores = rng.pareto(1.5, (2000, 20))  # of infinite variance
    assert 0.87 <= np.mean([row[-1] <= factor_of(row[:-1]) for row in scores]) <= 0.93


def test_no_score_promises_nothing():
    assert factor_of([]) == np.inf


def test_a_run_like_the_validation_run_has_its_error_widened():
    one = calibration([0.1], [0.3])
    bound = one.bound(T, 0.3 * RAMP, 2.0)
    np.testing.assert_allclose(bound, widening(1) * 0.2 * RAMP)
    assert one.share == pytest.approx(1.0 / widening(1))
    assert one.coarse


def test_it_is_never_better_than_at_validation_and_grows_with_the_signal():
    one = calibration([0.1, 0.2, 0.3], [0.3, 0.6, 0.9])
    assert one.slope == pytest.approx(2.0 / 3.0)
    quiet, loud = (one.bound(T, signal * RAMP, 2.0)[-1] for signal in (0.0, 3.0))
    assert quiet == pytest.approx(one.factor * 0.4 * RAMP[-1])  # 0.2 of 2 m, the middle one
    assert loud == pytest.approx(one.factor * 2.0 * RAMP[-1])
    assert one.factor == pytest.approx(widening(3))  # signals told all of the difference


def test_a_family_of_parameters_inherits_the_largest_error():
    one = calibration([0.1, 0.4], [0.3, 0.3], floor=1.0)
    assert rms(one.bound(T, 0.0 * RAMP, 2.0)) / 2.0 == pytest.approx(widening(2) * 0.4)
    assert one.typical == pytest.approx(0.5 * (0.25 + 1.0))  # of the errors over the largest


def test_where_signals_tell_nothing_the_largest_error_counts():
    one = calibration([0.1, 0.4], [0.3, 0.3])
    held = rms(one.bound(T, 0.3 * RAMP, 2.0)) / 2.0
    assert held == pytest.approx(widening(2) * 0.4)


def test_a_signal_that_is_always_zero_counts_for_nothing():
    one = calibration([0.1, 0.1], [0.0, 0.0])
    assert one.slope == 0.0
    np.testing.assert_allclose(one.bound(T, RAMP, 2.0), one.factor * 0.2 * RAMP)


def test_a_lost_run_has_no_bound():
    signal = np.array([0.0, 0.1, np.inf, np.inf, np.inf])
    assert np.isinf(calibration([0.1], [0.3]).bound(T, signal, 2.0)).tolist() == [
        False,
        False,
        True,
        True,
        True,
    ]


def test_a_lost_validation_run_counts_for_nothing():
    one = calibration([0.1, np.inf], [0.3, np.inf])
    assert (one.lost, len(one.errors)) == (1, 1)
    gone = calibration([np.inf], [0.3])
    assert np.isinf(gone.bound(T, 0.3 * RAMP, 2.0)).all()


def test_lights():
    assert [flag_of(b, 0.2) for b in (0.1, 0.11, 0.2, 0.21, np.inf)] == [
        "green",
        "amber",
        "amber",
        "red",
        "red",
    ]
    assert flag_of(np.nan, 0.2) == "unknown"


@pytest.mark.parametrize("shares", [[0.1, 0.2], [np.inf]])
def test_round_trip(shares):
    one = calibration(shares, [0.3] * len(shares))
    other = Calibration.read(json.loads(json.dumps(one.plain(), allow_nan=False)))
    assert {k: np.array(v).tolist() for k, v in vars(one).items()} == {
        k: np.array(v).tolist() for k, v in vars(other).items()
    }


@pytest.mark.parametrize("t", [[0.0], [1.0, 0.0, 2.0, 3.0, 4.0]])
def test_what_is_no_calibration(t):
    with pytest.raises(ValueError, match="times and curve do not fit"):
        Calibration.read(calibration([0.1], [0.3]).plain() | {"t": t})
