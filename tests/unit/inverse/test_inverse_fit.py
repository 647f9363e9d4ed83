"""Estimates from observations that runs by a recurrence made, where the truth is known to round-off."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from nsf.errors import ConfigError
from nsf.inverse.fit import ModelError, Offsets, fit
from nsf.inverse.observations import Observations, View
from nsf.inverse.recurrence import with_jacobian
from nsf.inverse.space import Space

TRUTH = {"friction_angle": 27.0, "speed": 0.2}


@pytest.fixture(scope="module")
def points(model):
    return model.manifold.X[::17].numpy()


@pytest.fixture(scope="module")
def seen(model, points):
    """What the model itself shows at the truth, at times between its frames too."""
    t = np.array([0.03, 0.071, 0.12])
    empty = Observations.of_points(t, points, np.zeros((3, len(points), 3)), 1e-4)
    values = View(empty, model).of_runs(model(TRUTH)[None])[0]
    return replace(empty, values=values.numpy())


@pytest.fixture(scope="module")
def no_error(model, seen):
    """As if the validation runs were the model's own."""
    parameters = np.array([[24.0, 0.1], [30.0, 0.2], [36.0, 0.28], [26.0, 0.25]])
    return ModelError(parameters, np.zeros((4, len(seen))))


def test_the_truth_is_found(model, seen, no_error):
    found = fit(View(seen, model), model, error=no_error)
    assert found.space.free == model.names
    np.testing.assert_allclose(found.estimate, [27.0, 0.2], rtol=1e-3)
    np.testing.assert_allclose(found.fitted, found.estimate)
    assert np.abs(found.residuals).max() < 0.1
    assert found.error_bound < np.inf


def test_its_standard_error_is_that_of_many_noises(model, seen, no_error):
    generator = np.random.default_rng(0)
    noisy = [
        replace(seen, values=seen.values + 1e-4 * generator.standard_normal(len(seen))) for _ in range(6)
    ]
    found = [fit(View(own, model), model, error=no_error) for own in noisy]
    off = np.array([own.estimate - [27.0, 0.2] for own in found]) / found[0].standard_error
    assert 0.5 < np.sqrt(np.mean(off**2)) < 1.6
    np.testing.assert_allclose(found[0].correlation, found[0].correlation.T)
    assert (found[0].share < 1e-6).all()


def test_the_models_own_error_puts_off_as_far_as_a_fit_would_be(model, seen, no_error):
    """Neither is drawn to the middle of the ranges, however little the observations say."""
    view, space = View(seen, model), Space.of(model)
    u = torch.as_tensor(space.units(no_error.parameters))
    J = with_jacobian(lambda rows: view.of_runs(model(space.parameters(rows))), u)[1].numpy()
    least = np.linalg.svd(J, compute_uv=False).min(1)
    scale = np.full(len(seen), 12.0**-0.5 * least.min() / 1.2)  # of which the least said is hardly told
    error = replace(no_error, vectors=np.einsum("vmn,n->vm", J, [0.03, -0.02]))
    off = error.offsets(view, model, space, scale).off
    np.testing.assert_allclose(off, np.tile([0.03, -0.02], (4, 1)), atol=1e-6)


def test_the_models_own_error_moves_and_widens(model, seen, no_error):
    view = View(seen, model)
    with torch.no_grad():
        u = torch.as_tensor(Space.of(model).units(np.array([[27.0, 0.2]])))
    slopes = with_jacobian(lambda rows: view.of_runs(model(Space.of(model).parameters(rows))), u)[1][
        0
    ].numpy()
    shift = slopes @ np.array([0.02, 0.0])  # as much as the first parameter does by 2 % of its range
    scatter = slopes @ np.array([0.0, 0.02])
    own = replace(no_error, vectors=np.array([shift + k * scatter for k in (-1.0, 1.0, -1.0, 1.0)]))
    found, exact = fit(view, model, error=own), fit(view, model, error=no_error)
    low, high = model.ranges[0]
    assert (found.fitted - found.estimate)[0] / (high - low) == pytest.approx(0.02, abs=0.008)
    assert found.standard_error[0] > exact.standard_error[0]
    assert found.standard_error[1] > 2 * exact.standard_error[1]  # it scatters as by the second parameter
    assert found.share[1] > 0.5


def test_validation_runs_tell_the_error(model, seen):
    own = ModelError.of(View(seen, model), model)
    assert own.vectors.shape == (4, len(seen))
    assert 0.0 < own.deviations.max() < 0.02


def test_a_parameter_may_be_given(model, seen, no_error):
    found = fit(
        View(seen, model), model, Space.of(model, {"speed": 0.2, "friction_angle": [25.0, 30.0]}), no_error
    )
    assert found.space.free == ("friction_angle",)
    assert found.estimate[0] == pytest.approx(27.0, rel=1e-3)


# -- offsets --------------------------------------------------------------------------------------------


def test_a_plane_of_offsets_is_followed():
    u = np.random.default_rng(0).random((20, 2))
    slopes = np.array([[0.3, -0.1], [0.2, 0.4]])
    mean, covariance, freedom = Offsets(u, 0.05 + u @ slopes).near(np.array([0.4, 0.7]))
    np.testing.assert_allclose(mean, 0.05 + np.array([0.4, 0.7]) @ slopes)
    np.testing.assert_allclose(covariance, 0.0, atol=1e-20)
    assert freedom == pytest.approx(0.75 * 20 - 3, abs=1e-3)


def test_offsets_that_scatter_have_their_covariance():
    generator = np.random.default_rng(1)
    u, found = generator.random((40, 1)), []
    for _ in range(200):
        mean, covariance, _ = Offsets(u, 0.1 + 0.02 * generator.standard_normal((40, 1))).near(
            np.array([0.5])
        )
        found.append([mean[0], covariance[0, 0]])
    mean, variance = np.mean(found, axis=0)
    assert mean == pytest.approx(0.1, abs=0.002)
    assert np.sqrt(variance) == pytest.approx(0.02, rel=0.08)


def test_few_offsets_have_a_mean():
    mean, covariance, freedom = Offsets(np.array([[0.2], [0.8]]), np.array([[0.01], [0.03]])).near(
        np.array([0.5])
    )
    assert mean == pytest.approx(0.02)
    assert covariance[0, 0] > 1e-4
    assert freedom == pytest.approx(1.0)


# -- bad input ------------------------------------------------------------------------------------------


def test_fewer_observations_than_parameters(model, seen, no_error):
    one = Observations(seen.t[:1], seen.what[:1], seen.points[:1], seen.values[:1], seen.deviations[:1])
    own = replace(no_error, vectors=no_error.vectors[:, :1])
    with pytest.raises(
        ConfigError, match="1 observation cannot tell 2 parameters, friction_angle, speed; obs"
    ):
        fit(View(one, model), model, error=own)


def test_parameters_that_are_not_told_apart_are_named(model, seen, no_error):
    blurred = replace(seen, deviations=np.full(len(seen), 50.0))
    with pytest.raises(
        ConfigError, match=r"do not tell speed: they hardly change where speed grows; .* give speed"
    ):
        fit(View(blurred, model), model, error=no_error)


@pytest.mark.parametrize(
    ("asked", "told"),
    [
        ({"cohesion": 1.0}, "there is no parameter 'cohesion'; there are friction_angle, speed"),
        ({"speed": [0.01, 0.2]}, "speed=0.01..0.2 goes beyond what was taught, 0.07"),
        ({"speed": 0.5}, "speed=0.5 goes beyond what was taught"),
        ({"speed": [0.2, 0.1]}, "speed=0.2..0.1 is the wrong way round; give speed=0.1..0.2"),
        ({"speed": [0.2, 0.2]}, "speed has an empty range; give speed=0.2"),
        ({"speed": 0.2, "friction_angle": 27.0}, "every parameter is given"),
    ],
)
def test_ranges_are_refused(model, asked, told):
    with pytest.raises(ConfigError, match=told.replace(".", r"\.")):
        Space.of(model, asked)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"t": 0.5}, r"t=0\.5 s is outside of the run, 0 … 0\.12 s"),
        ({"deviations": 0.0}, r"deviation=0 m must be positive"),
        ({"deviations": np.inf}, r"deviation=inf m must be positive and finite"),
        ({"values": np.inf}, r"an observed value is inf m; give finite positions"),
        ({"points": 2.0}, r"the point \(2, 2, 2\) m lies .* outside of the body"),
    ],
)
def test_observations_are_refused(model, seen, change, told):
    ((name, value),) = change.items()
    with pytest.raises(ConfigError, match=told):
        View(replace(seen, **{name: np.full_like(getattr(seen, name), value)}), model)


def test_too_few_validation_runs(model, seen, monkeypatch):
    split = replace(model.pipeline.split, validation=model.pipeline.split.validation[:1])
    monkeypatch.setattr(model.pipeline, "split", split)
    with pytest.raises(ConfigError, match="1 validation runs cannot tell the model's own error"):
        ModelError.of(View(seen, model), model)
