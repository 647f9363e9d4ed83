"""Drawn parameters: distributions, quantiles, sensitivities and posteriors of the tiny model."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from nsf.errors import ConfigError, InstabilityError
from nsf.inverse.fit import ModelError, fit
from nsf.inverse.observations import Observations, View
from nsf.inverse.reports.command import sample
from nsf.inverse.sampling import Posterior, Prior, Scalars, distribution, posterior, runs, sensitivities


def test_distributions_are_those_of_scipy():
    assert distribution("norm(30, 2)").std() == 2.0
    assert distribution("25..35").support() == (25.0, 35.0)
    assert distribution("truncnorm(-2,2,30,1)").support() == (28.0, 32.0)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("normal(30,2)", "is no distribution; give one of scipy.stats"),
        ("__import__('os')", "is no distribution"),
        ("norm(a,2)", "norm=a is no number"),
        ("norm(1,2,3,4)", "see scipy.stats.norm"),
        ("norm(30,-2)", "has no finite spread"),
        ("35..25", "nothing between its ends"),
    ],
)
def test_distributions_are_refused(text, told):
    with pytest.raises(ConfigError, match=told):
        distribution(text)


def test_priors(model):
    prior = Prior.of(model, {"friction_angle": "norm(30,1)"})
    drawn = prior.draw(4000, 0)
    np.testing.assert_allclose(drawn.mean(0), [30.0, model.ranges[1].mean()], rtol=0.01)
    assert drawn[:, 1].min() >= model.ranges[1, 0]
    np.testing.assert_array_equal(drawn, prior.draw(4000, 0))
    inside, outside = prior.log_density(np.array([[30.0, 0.1], [30.0, 0.4]]))
    assert inside == pytest.approx(stats.norm(30, 1).logpdf(30.0) - np.log(np.ptp(model.ranges[1])))
    assert outside == -np.inf
    with pytest.raises(ConfigError, match=r"speed=0\.1\.\.0\.9 goes beyond what was taught"):
        Prior.of(model, {"speed": "0.1..0.9"})
    with pytest.raises(ConfigError, match="there is no parameter 'E'"):
        Prior.of(model, {"E": "0.1..0.9"})


def test_what_is_asked(model):
    asked = Scalars(["height", "springback", "z@0.5:0.5:0.2"], model)
    found = runs(model, np.array([[24.0, 0.1], [36.0, 0.3]]), asked)
    assert found.values.shape == (2, 3, len(asked.t))
    frame = model(model.tensor([24.0, 0.1]))[-1]
    z = model.positions(frame, np.array([[0.5, 0.5, 0.2]]))[0, 2]
    assert found.values[0, 2, -1] == pytest.approx(float(z))
    assert (found.values[:, 1] >= 0.0).all()
    with pytest.raises(ConfigError, match="of=width is none of height"):
        Scalars(["width"], model)
    with pytest.raises(ConfigError, match="outside of the body"):
        Scalars(["x@3:0:0"], model)


def test_distrusted_runs_are_counted_apart(model):
    asked = Scalars(["height"], model)
    within = np.array([[27.0, 0.2], [29.0, 0.2]])
    mixed = runs(model, np.concatenate([within, [[80.0, 0.2]]]), asked)
    assert mixed.trusted.tolist() == [True, True, False]
    np.testing.assert_array_equal(
        mixed.quantiles()["height"], runs(model, within, asked).quantiles()["height"]
    )
    with pytest.raises(InstabilityError, match="no run is to be believed"):
        runs(model, np.array([[80.0, 0.2]]), asked).quantiles()


def test_full_order_quantities_beside(model, deployed):
    from nsf.data import Trajectory

    asked, case = Scalars(["height", "run_out", "z@0.5:0.5:0.2"], model), deployed.split.test[0]
    found = runs(model, np.array([list(case.parameters.values())]), asked).values[0, :, -1]
    with Trajectory.open(deployed.simulation(case).file("trajectory.h5")) as truth:
        np.testing.assert_allclose(asked.of_truth(truth), found, atol=0.01)


def test_sensitivities_of_a_known_function(model):
    pytest.importorskip("SALib", reason="SALib is not installed; pip install 'nsf[inverse]'")
    prior = Prior.of(model, {"friction_angle": "25..26", "speed": "0.1..0.2"})

    def linear(values):
        return np.stack([3.0 * (values[:, 0] - 25.0) + 4.0 * 10.0 * (values[:, 1] - 0.1)], 1)

    table = sensitivities(prior, 512, linear, ["sum"])
    assert table["first"].tolist() == pytest.approx([9 / 25, 16 / 25], abs=0.02)
    assert table["total"].tolist() == pytest.approx([9 / 25, 16 / 25], abs=0.02)
    with pytest.raises(ConfigError, match="a design of 100 must be of a power of two"):
        sensitivities(prior, 100, linear, ["sum"])


@pytest.mark.slow
def test_a_posterior_is_the_estimate_where_the_prior_is_wide(model, monkeypatch):
    pytest.importorskip("emcee", reason="emcee is not installed; pip install 'nsf[inverse]'")
    t, points = np.array([0.06, 0.12]), model.manifold.X[::25].numpy()
    empty = Observations.of_points(t, points, np.zeros((2, len(points), 3)), 5e-4)
    seen = replace(empty, values=View(empty, model).of_runs(model([[27.0, 0.2]]))[0].numpy())
    own = ModelError(np.array([[24.0, 0.1], [30.0, 0.2], [36.0, 0.28]]), np.zeros((3, len(seen))))
    view = View(seen, model)
    found = fit(view, model, error=own)
    made = posterior(Prior.of(model, {}), view, found, 2000)
    drawn = made.values
    assert drawn.shape == (2000, 2)
    assert made.length >= 50.0
    assert made.warnings == []
    np.testing.assert_allclose(drawn.mean(0), found.estimate, atol=0.3 * found.standard_error.max())
    assert (np.abs(drawn.std(0) / found.standard_error - 1.0) < 0.3).all()
    monkeypatch.setattr(
        "nsf.inverse.sampling._LENGTH", 10.0
    )  # where they lie shows sooner than how they vary
    narrow = posterior(Prior.of(model, {"friction_angle": "norm(33,0.01)"}), view, found, 500).values
    assert narrow[:, 0].mean() > found.estimate[0] + 2 * found.standard_error[0]
    # Nothing of this prior is where the estimate is.
    apart = posterior(Prior.of(model, {"friction_angle": "33..35"}), view, found, 500).values
    assert apart[:, 0].min() >= 33.0
    assert 0.0 < np.ptp(apart[:, 0]) < 2.0
    with pytest.raises(ConfigError, match=r"friction_angle has nothing within what was taught, 23.*36.4779"):
        posterior(Prior.of(model, {"friction_angle": "norm(60,1)"}), view, found, 500)


def test_a_chain_that_is_too_short_or_stands_still_is_said():
    good = Posterior(np.zeros((3, 1)), 100, 65.0, 0.5)
    assert good.warnings == []
    assert "65 autocorrelation times; 50 % of the proposals" in good.text
    assert "is 3 autocorrelation times long" in replace(good, length=3.0).warnings[0]
    assert "accepts 1 % of the proposals" in replace(good, accepted=0.01).warnings[0]


def test_the_command(tmp_path, deployed):
    words = [f"run={deployed.deployment.path}", "runs=50", "of=height,run_out", "device=cpu"]
    sample([*words, "friction_angle=norm(30,2)", f"folder={tmp_path / 'a'}"])
    rows = pd.read_csv(tmp_path / "a" / "runs.csv.gz")
    assert list(rows) == ["friction_angle", "speed", "height", "run_out", "error_bound"]
    bands = pd.read_csv(tmp_path / "a" / "quantiles.csv")
    assert set(bands["quantity"]) == {"height", "run_out"}
    assert (bands["q5"] <= bands["q95"]).all()
    assert (tmp_path / "a" / "quantiles.png").is_file()
    with pytest.raises(ConfigError, match="has no programs; leave it out"):
        sample([*words, "program=3"])


@pytest.mark.slow
def test_the_command_with_both_libraries(tmp_path, deployed, model):
    for name in ("SALib", "emcee"):
        pytest.importorskip(name, reason=f"{name} is not installed; pip install 'nsf[inverse]'")
    x = model.positions(model([[27.0, 0.2]])[0, 24], np.arange(0, 500, 40)).numpy()
    rows = [
        {"t": model.t[24], "particle": 40 * k, **dict(zip("xyz", at, strict=True)), "deviation": 1e-3}
        for k, at in enumerate(x)
    ]
    pd.DataFrame(rows).to_csv(tmp_path / "seen.csv", index=False)
    words = [
        f"run={deployed.deployment.path}",
        "runs=40",
        "device=cpu",
        f"observations={tmp_path / 'seen.csv'}",
    ]
    sample([*words, "sensitivities=16", "full_order=2", f"folder={tmp_path / 'a'}"])
    table = pd.read_csv(tmp_path / "a" / "sensitivities.csv")
    assert table["parameter"].tolist() == ["friction_angle", "speed"]
    assert {"first_full_order", "first_same_design", "total_full_order"} <= set(table)
    drawn = pd.read_csv(tmp_path / "a" / "posterior.csv")
    low, high = model.ranges.T
    assert ((drawn >= low) & (drawn <= high)).all(axis=None)
    assert (tmp_path / "a" / "posterior.png").is_file()
    taken = pd.read_csv(tmp_path / "a" / "runs.csv.gz")["speed"].to_numpy()
    assert np.abs(taken[:, None] - drawn["speed"].to_numpy()).min(1).max() < 1e-5


@pytest.mark.parametrize(
    ("more", "told"),
    [
        (["full_order=2"], "give sensitivities= too"),
        (["sensitivities=100", "of=none"], "sensitivities=100 must be a power of two"),
        (["sensitivities=16", "full_order=3", "of=none"], "full_order=3 must be a power of two"),
        (["sensitivities=16", "full_order=2", "program=3"], "has no programs; leave it out"),
    ],
)
def test_full_order_runs_that_would_show_something_else_are_refused(tmp_path, deployed, more, told):
    with pytest.raises(ConfigError, match=told):
        sample([f"run={deployed.deployment.path}", "device=cpu", f"folder={tmp_path / 'a'}", *more])
