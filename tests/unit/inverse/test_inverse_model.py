"""`nsf.Model` beside the engine that it stands for, and its gradients beside differences."""

import numpy as np
import pytest
import torch

import nsf
from nsf.deployment import Rollout, rollout_file
from nsf.errors import ConfigError, ShapeError
from nsf.inverse import Forcing
from nsf.inverse.model import Polynomial

ONE = {"friction_angle": 27.0, "speed": 0.2}


def test_runs_are_those_of_the_engine(deployed, model):
    runs = [Rollout.open(deployed.deployment.file(rollout_file(i))) for i in range(2)]
    mu = torch.tensor([list(run.case.parameters.values()) for run in runs], dtype=torch.float64)
    assert model.names == ("friction_angle", "speed")
    assert model.units == ("°", "m/s")
    found = model(mu)
    assert found.shape == (2, 25, 4)
    for own, run in zip(found, runs, strict=True):
        np.testing.assert_allclose(own, run.xhat, atol=1e-9)
        np.testing.assert_allclose(model.t, run.t)
    assert np.ptp(np.stack([run.xhat for run in runs]), axis=0).max() > 0.01, "both runs are one"


def test_it_is_loaded_by_the_name_of_its_run(deployed, model):
    again = nsf.Model.load(deployed.deployment.path, "cpu")
    torch.testing.assert_close(again(ONE), model(ONE))


def test_parameters_come_as_numbers_or_arrays_by_name(model):
    angles = torch.tensor([24.0, 27.0, 30.0])
    several = model({"friction_angle": angles, "speed": 0.2})
    assert several.shape == (3, 25, 4)
    torch.testing.assert_close(several[1], model(ONE))
    torch.testing.assert_close(several[1], model([27.0, 0.2]))


def test_gradients_are_those_of_differences(model):
    points = np.array([3, 70, 200])
    mu = torch.tensor([27.0, 0.2], dtype=torch.float64, requires_grad=True)

    def seen(mu):
        return model.positions(model(mu)[-1], points)

    assert torch.autograd.gradcheck(seen, mu, eps=1e-4, atol=1e-6, rtol=1e-4)
    slope = torch.autograd.functional.jacobian(seen, mu)
    assert (slope.abs().amax((0, 1)) > 1e-5).all(), "a parameter that moves nothing shows nothing"


def test_the_forcing_of_each_run_is_its_own(model):
    own = model.forcing()
    torch.testing.assert_close(model(ONE, own), model(ONE))
    both = Forcing(torch.stack([own.gravity, 1.1 * own.gravity]), own.solids)
    mu = model.tensor([[27.0, 0.2], [27.0, 0.2]])
    found = model(mu, both)
    torch.testing.assert_close(found[0], model(ONE))
    assert (found[1] - found[0]).abs().max() > 1e-3


def test_positions_anywhere_in_the_body(model):
    X = model.manifold.X[[5, 30]].numpy()
    xhat = model(ONE)[[0, 12, 24]]
    at_particles = model.positions(xhat, [5, 30])
    assert at_particles.shape == (3, 2, 3)
    torch.testing.assert_close(model.positions(xhat, X), at_particles, atol=1e-7, rtol=0)
    torch.testing.assert_close(model.positions(xhat, model.at([5, 30])), at_particles)
    assert np.abs(at_particles[0].numpy() - X).max() < 0.01, "a run begins at rest"


def test_a_bound_is_the_deployments(model, deployed):
    inside, outside = model.error_bound([[27.0, 0.2], [60.0, 0.2]])
    assert inside < np.inf
    assert outside == np.inf
    own = model.forcing()
    assert model.error_bound(ONE, Forcing(-own.gravity, own.solids)) == np.inf
    rollout = Rollout.open(deployed.deployment.file(rollout_file(0)))
    bound = model.error_bound([rollout.case[name] for name in model.names])
    assert float(bound) == pytest.approx(rollout.verdict.bound_share, rel=0.1)


def test_bad_input(model, chain):
    with pytest.raises(ConfigError, match="'cohesion': give a value for each of friction_angle, speed"):
        model(ONE | {"cohesion": 1.0})
    with pytest.raises(ShapeError, match=r"shape \[3\]; give \[..., 2\], as friction_angle, speed"):
        model([1.0, 2.0, 3.0])
    with pytest.raises(
        ConfigError, match=r"model=projected, whose steps know no gradient; .* model=recurrence"
    ):
        nsf.Model.load(chain.pipeline.deployment, "cpu")


# -- polynomials ----------------------------------------------------------------------------------------


def test_a_direction_is_a_polynomial_of_its_angle():
    def of(mu):
        return np.array([[np.sin(mu[1]), np.cos(mu[1])], [mu[0], 0.0]])

    found = Polynomial(of, np.array([[1.0, 3.0], [0.1, 0.9], [0.0, 1.0]]), ("abc", "motion"))
    mu = torch.tensor([[1.7, 0.33, 0.2], [2.9, 0.88, 0.9]], dtype=torch.float64, requires_grad=True)
    np.testing.assert_allclose(found(mu).detach(), [of(row) for row in mu.detach().numpy()], atol=1e-8)
    assert torch.autograd.gradcheck(found, mu)


def test_scenes_that_are_built_grow_with_the_parameters_alone():
    built = []

    def of(mu):
        built.append(mu)
        return mu[0] * np.array([np.sin(mu[1]), np.cos(mu[1])]) + mu[2:] @ np.arange(14.0).reshape(7, 2)

    ranges = np.array([[1.0, 3.0], [0.1, 0.9], *([[0.0, 1.0]] * 7)])
    found = Polynomial(of, ranges, ("abcdefghi", "motion"))
    assert len(built) < 250  # all products of nine parameters would be 9**9
    mu = torch.rand(4, 9, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    mu = torch.as_tensor(ranges[:, 0]) + mu * torch.as_tensor(np.ptp(ranges, axis=1))
    np.testing.assert_allclose(found(mu), [of(row) for row in mu.numpy()], atol=1e-8)


def test_a_scene_is_built_once(model, monkeypatch):
    expected = model(ONE)
    again = nsf.Model(model.run, "cpu")
    built = []
    own = type(again)._inputs_of
    monkeypatch.setattr(
        type(again), "_inputs_of", lambda self, case: built.append(dict(case)) or own(self, case)
    )
    torch.testing.assert_close(again(ONE), expected)
    assert len(built) == len({tuple(case.items()) for case in built}) < 30


def test_what_no_parameter_changes_is_held_once():
    found = Polynomial(lambda mu: np.eye(3), np.array([[1.0, 3.0]]), (("E",), "motion"))
    assert not found.varies
    np.testing.assert_array_equal(found(torch.zeros(7, 1)), np.eye(3))


def test_a_jump_is_refused():
    with pytest.raises(ConfigError, match="E changes the motion in a way that no polynomial follows"):
        Polynomial(lambda mu: np.floor(mu), np.array([[0.5, 3.2]]), (("E",), "motion"))
