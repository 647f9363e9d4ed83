"""Rivals of a reduced run: the nearest training run, their interpolation, and a coarser full-order run."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from angles import angle

from nsf.data import Trajectory
from nsf.errors import ConfigError
from nsf.evaluation.rivals import TrainingRuns, coarse_run, coarse_scene, coarse_subjects, rivals
from nsf.mpm import Cuboid


def _times(scene) -> np.ndarray:
    return scene.dt * np.arange(scene.steps + 1)


@pytest.fixture
def runs(tiny_manifold):
    return TrainingRuns.of(tiny_manifold)


def test_training_runs_are_those_of_the_manifold(runs, tiny_manifold):
    assert runs.latents.shape == (3, 25, 4)
    np.testing.assert_array_equal(runs.latents.reshape(-1, 4), tiny_manifold.training_latents)
    np.testing.assert_allclose(runs.parameters[:, 0], [-np.sqrt(1.5), 0.0, np.sqrt(1.5)])


@pytest.mark.parametrize(("value", "run"), [(25.9, 0), (26.1, 1), (33.0, 1), (50.0, 2)])
def test_nearest_is_the_run_of_the_nearest_value(runs, value, run):
    np.testing.assert_array_equal(runs.nearest([value]), runs.latents[run])


def test_interpolation_is_linear_between_training_values_and_exact_at_them(runs):
    np.testing.assert_allclose(runs.interpolated([30.0]), runs.latents[1], atol=1e-10)
    mixed = 0.25 * runs.latents[0] + 0.75 * runs.latents[1]
    np.testing.assert_allclose(runs.interpolated([28.0]), mixed, atol=1e-10)
    np.testing.assert_allclose(runs.interpolated([60.0]), runs.latents[2], atol=1e-10)


def test_interpolation_over_two_parameters_keeps_training_runs():
    parameters = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]])
    latents = np.random.default_rng(0).normal(size=(4, 5, 2))
    runs = TrainingRuns(parameters, latents, np.zeros(2), np.ones(2))
    for values, own in zip(parameters, latents, strict=True):
        np.testing.assert_allclose(runs.interpolated(values), own, atol=1e-10)
    middle = runs.interpolated([0.5, 0.5])
    np.testing.assert_allclose(middle, latents.mean(0), atol=1e-10)  # by symmetry


def test_rivals_are_held_to_every_particle_and_frame(chain, tiny_manifold, truth, runs):
    solver = chain.pipeline.solver_at(tiny_manifold, angle(26.0))
    told = []
    found = rivals(solver, truth, [2], advance=told.append)
    x, X = truth.read("x")[1:], truth.X
    assert sum(told) == len(x) + truth.frames  # compared, and of the coarse run
    norm = np.linalg.norm(x - X)
    assert found.static == pytest.approx(1.0)
    for error, xhat in (
        (found.nearest, runs.nearest([26.0])),
        (found.interpolated, runs.interpolated([26.0])),
    ):
        g = solver.decoder().position(torch.as_tensor(xhat))[1:].numpy()
        assert error == pytest.approx(np.linalg.norm(g - x) / norm, rel=1e-5)
    coarse = coarse_run(chain.scene, {"friction_angle": 26.0}, X, _times(chain.scene), 2, "fp64", "cpu")
    assert found.coarse[2]["displacement_error"] == pytest.approx(np.linalg.norm(coarse.x[1:] - x) / norm)
    assert found.coarse[2]["particles"] == coarse.particles
    assert found.factors == [2]


def test_the_nearest_run_of_a_training_value_is_its_own(chain, tiny_manifold):
    with Trajectory.open(chain.trajectory(30.0)) as known:
        found = rivals(chain.pipeline.solver_at(tiny_manifold, 30.0), known)
    assert found.nearest == pytest.approx(found.interpolated)
    assert found.nearest < 0.02
    assert found.coarse == {}


def test_a_coarse_run_is_timed_over_its_own_steps(chain):
    subjects = coarse_subjects(chain.scene, {"friction_angle": 26.0}, [2], "fp64", "cpu")
    coarse = coarse_scene(chain.scene, {"friction_angle": 26.0}, 2)
    assert subjects["coarse_2"].steps == coarse.steps
    solver = subjects["coarse_2"].build()
    solver.step(coarse.steps)
    assert solver.time == pytest.approx(chain.scene.dt * chain.scene.steps)


def test_a_coarse_run_has_the_frames_and_particles_of_the_fine_one(chain):
    scene = chain.scene
    fine = scene.at({"friction_angle": 26.0})
    X = fine.particles().X
    coarse = coarse_run(scene, {"friction_angle": 26.0}, X, _times(scene), 2, "fp64", "cpu")
    assert coarse.x.shape == (scene.steps + 1, 500, 3)
    np.testing.assert_allclose(coarse.x[0], X, atol=1e-12)
    assert coarse.dx == pytest.approx(2 * scene.dx)
    assert coarse.particles == round(500 / 8)
    assert scene.steps % coarse.steps == 0
    solver = scene.full_order({"friction_angle": 26.0}, device="cpu")
    solver.step(scene.steps)
    x = solver.state.numpy()["x"]
    error = np.linalg.norm(coarse.x[-1] - x) / np.linalg.norm(x - X)
    assert 0.01 < error < 0.6  # near, and not the same


def test_frames_of_a_coarse_run_are_those_at_the_times(chain):
    scene, case = chain.scene, {"friction_angle": 26.0}
    X, t = scene.particles().X, _times(scene)
    each = coarse_run(scene, case, X, t, 2, "fp64", "cpu").x
    np.testing.assert_array_equal(coarse_run(scene, case, X, t[::6], 2, "fp64", "cpu").x, each[::6])


def test_a_rigid_fall_is_the_same_on_a_coarse_grid(chain):
    column = {"velocity": (0.1, 0.0, 0.2), "shape.base": (0.5, 0.5, 0.5)}  # clear of the sticky floor
    column = {f"bodies.column.{key}": value for key, value in column.items()}
    scene = chain.scene.changed({"gravity": (0.0, 0.0, 0.0)} | column)
    X = scene.particles().X
    coarse = coarse_run(scene, {"friction_angle": 26.0}, X, _times(scene), 2, "fp64", "cpu")
    t = scene.dt * np.arange(scene.steps + 1)[:, None, None]
    np.testing.assert_allclose(coarse.x, X + t * np.array([0.1, 0.0, 0.2]), atol=1e-10)


def test_a_scene_that_no_coarse_grid_resolves_says_why(chain):
    blade = Cuboid((0.8, 0.8, 0.8), (0.07, 0.07, 0.07), "separate")
    scene = replace(chain.scene, colliders={**chain.scene.colliders, "blade": blade})
    told = []
    fine = scene, {"friction_angle": 26.0}, scene.particles().X, _times(scene)
    reason = coarse_run(*fine, 2, "fp64", "cpu", told.append)
    assert "needs dx of at most" in reason
    assert told == [scene.steps + 1]


@pytest.mark.parametrize(
    ("asked", "message"),
    [("2", "must be a list of factors"), ("[1]", r"evaluation\.coarse=1"), ("[2,2]", "names a factor twice")],
)
def test_factors_that_are_refused(pipeline_at, tmp_path, asked, message):
    with pytest.raises(ConfigError, match=message):
        pipeline_at(tmp_path, f"evaluation.coarse={asked}")
