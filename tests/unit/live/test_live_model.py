"""A deployment run at any value: the numbers are the deployment's own, the range is the scene's."""

import math
import shutil
from dataclasses import replace

import numpy as np
import pytest
from angles import angle

from nsf.data import Trajectory
from nsf.deployment import Rollout
from nsf.errors import ConfigError, MissingRunError
from nsf.live.model import LiveModel


def whole(model, value):
    run = model.start(angle(value))
    while not run.finished:
        run.advance(7)
    return run


@pytest.fixture(scope="module")
def run(model):
    return whole(model, 26.0)


def test_it_is_the_deployed_run(chain, run):
    deployed = Rollout.open(chain.pipeline.deployment.path / "rollout_0.h5")
    assert run.reached == run.steps == len(deployed.t) - 1
    found = np.stack([run.xhat(n) for n in range(run.steps + 1)])
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, deployed.xhat, rtol=0, atol=0.02)  # deviations; fp32, not fp64
    live = run.verdict(run.steps)
    assert live.text == deployed.verdict.text
    assert live.flag == "unknown"
    np.testing.assert_allclose(run._signal, deployed.signal, atol=0.02 * deployed.signal.max())
    assert not run.diverged


def test_it_decodes_the_particles_that_are_shown(chain, model, run):
    solver = chain.pipeline.solver_at(model.manifold, angle(26.0))
    solver.step(solver.total_steps)
    state = solver.state.numpy()
    moved = np.abs(state["x"] - model.manifold.X.numpy()).max()
    assert np.abs(run.positions(run.steps) - state["x"][model.shown]).max() < 2e-3 * moved
    tau = state["tau"][model.shown][:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    assert np.abs(run.stress(run.steps) - tau).max() < 1e-2 * np.abs(tau).max()


def test_what_is_shown_holds_the_sample(model, chain):
    assert len(model.shown) == 200
    assert (np.diff(model.shown) > 0).all()
    roles = model.roles(3)
    assert (roles == 2).sum() == chain.pipeline.sampler.size
    assert set(np.unique(roles)) <= {0, 1, 2}
    few = LiveModel(model.run, points=1, device="cpu")
    assert (few.roles(0) == 2).all()
    assert len(LiveModel(model.run, points=10_000, device="cpu").shown) == model.particles


def test_the_parameter_reaches_beyond_its_training_values(model):
    (p,) = model.parameters
    assert (p.name, p.unit, p.trained) == ("friction_angle", "°", (22.0, 38.0))
    assert (p.lower, p.upper) == (14.0, 46.0)
    assert model.simulated == tuple(map(angle, (22.0, 26.0, 30.0, 38.0)))
    runs = list(map(model.start, map(angle, (21.9, 22.0, 38.0, 42.0))))
    for run in runs:
        run.advance(1)
    assert [run.verdict(1).beyond for run in runs] == [True, False, False, True]


def test_the_parameter_stops_where_the_scene_does(chain, pipeline_at):
    """A friction angle must be below 90° and not below 0°."""
    from nsf.live.model import _parameters

    steep = pipeline_at(chain.root, "scene.design.train=[10,50,80]")
    (found,) = _parameters(steep, ())
    assert 0.0 <= found.lower < 10.0
    assert 80.0 < found.upper < 90.0


@pytest.mark.parametrize("value", [math.nan, math.inf, 13.9, 46.1, -1e30])
def test_values_out_of_reach_are_refused(model, value):
    with pytest.raises(ConfigError, match=r"friction_angle=.* must lie in \[14, 46\]"):
        model.checked([value])


def test_a_value_near_a_known_one_is_that(model):
    assert model.checked([26.05]) == angle(26.0)
    assert model.checked([26.5]) == angle(26.5)
    with pytest.raises(ConfigError, match="2 values must be 1, one for each parameter"):
        model.checked([26.0, 1.0])


def test_the_truth_is_the_trajectory(chain, model):
    truth = model.truth(angle(26.0))
    with Trajectory.open(chain.trajectory(26.0)) as trajectory:
        x = trajectory.read("x", particles=model.shown)
        dt = trajectory.dt
    np.testing.assert_array_equal(truth.positions(5 * dt), x[5])
    np.testing.assert_allclose(truth.positions(5.25 * dt), 0.75 * x[5] + 0.25 * x[6], rtol=1e-6)
    np.testing.assert_array_equal(truth.positions(1e3), x[-1])
    assert truth.stress(0.0).shape == (200, 6)
    assert model.truth(angle(26.5)) is None


def test_a_run_that_diverges_ends_with_its_last_good_step(model):
    run = model.start(angle(26.0))
    run.advance(3)
    run._solver.xhat[0] = 1e4
    run.advance(20)
    assert run.diverged
    assert run.finished
    assert run.reached < 23
    assert np.isfinite(run.positions(run.reached)).all()
    assert (run.verdict(run.reached).flag, run.verdict(2).flag) == ("red", "unknown")


def test_a_deployment_whose_training_is_gone_is_refused(chain, tmp_path):
    shutil.copytree(chain.root, tmp_path / "runs")
    run = replace(chain.pipeline.deployment, root=tmp_path / "runs")
    shutil.rmtree(tmp_path / "runs/train")
    with pytest.raises(MissingRunError, match="run `nsf train scene=sand`"):
        LiveModel(run, device="cpu")


def test_without_full_order_runs_there_is_no_truth(chain, tmp_path):
    shutil.copytree(chain.root, tmp_path / "runs")
    shutil.rmtree(tmp_path / "runs/simulate")
    model = LiveModel(replace(chain.pipeline.deployment, root=tmp_path / "runs"), device="cpu")
    assert model.simulated == ()
    assert model.truth(angle(26.0)) is None
