"""Fields of a reduced run at more points than it was trained on."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from angles import angle
from test_compare import rollout_of

from nsf import load_scene
from nsf.errors import ConfigError
from nsf.evaluation import metrics, query, superresolution, superresolve

FRAMES = [12, 24]


@pytest.fixture(scope="module")
def fine(chain, tiny_manifold, truth, made):
    (found,) = superresolve(tiny_manifold, chain.scene, [truth], [made], 3, FRAMES, device="cpu")
    return found


def test_a_refined_scene_begins_with_the_same_particles():
    ball = "{_target_: nsf.scenes.Body, shape: {_target_: nsf.scenes.Ball, centre: [0.5,0.5,0.6], radius: 0.1}, particles_per_cell: 2, density: 1}"  # fmt: skip # noqa: E501
    scene = load_scene("sand", ["scene.bodies.column.particles=300", f"+scene.bodies.ball={ball}"])
    fine = scene.refined(4)
    assert [b.particles for b in fine.bodies.values()] == [4 * b.particles for b in scene.bodies.values()]
    assert (fine.grid, fine.dt) == (scene.grid, scene.dt)
    before, after = scene.particles(), fine.particles()
    rows = superresolution._rows_in(fine, scene)
    np.testing.assert_array_equal(after.X[rows], before.X)
    assert after.mass.sum() == pytest.approx(before.mass.sum())


def test_query_is_the_restriction_in_groups(tiny_manifold, chain, monkeypatch):
    X = torch.tensor(chain.scene.refined(2).particles().X)
    xhat = tiny_manifold.training_latents[[3, 30]]
    whole = tiny_manifold.restrict(X=X).position(xhat)
    monkeypatch.setattr(superresolution, "POINTS", 64)
    found = query(tiny_manifold, X, xhat)
    assert found.shape == (2, 1000, 3)
    torch.testing.assert_close(found, whole, rtol=0, atol=1e-13)
    assert query(tiny_manifold, X, xhat.float()).dtype == torch.float32


def test_points_in_place_of_particles_give_their_positions(fine):
    assert 0 <= fine.row["query_difference"] < 1e-7


def test_row_against_a_fine_run_of_its_own(fine, chain, tiny_manifold, made, truth):
    scene = chain.scene.refined(3)
    solver, x_full = scene.full_order({"friction_angle": 26.0}, device="cpu"), []
    for _ in FRAMES:
        solver.step(12)
        x_full.append(solver.state.x.numpy().copy())
    x_full, X = torch.tensor(np.stack(x_full)), torch.tensor(scene.particles().X)
    x = tiny_manifold.restrict(X=X).position(torch.tensor(made.xhat[FRAMES]))
    row = fine.row
    assert (row["case"], row["factor"], row["points"]) == ("friction_angle=26°", 3, 1500)
    assert row["delta"] == pytest.approx(metrics.deformation_error(x, x_full), rel=1e-9)
    assert row["displacement_error"] == pytest.approx(metrics.displacement_error(x, x_full, X), rel=1e-9)
    few = slice(0, 500)
    assert row["particles_delta"] == pytest.approx(
        metrics.deformation_error(x[:, few], x_full[:, few]), rel=1e-6
    )
    coarse = torch.tensor(truth.read("x")[FRAMES])
    assert row["full_order_difference"] == pytest.approx(
        metrics.displacement_error(coarse, x_full[:, few], X[few]), rel=1e-9
    )
    assert 0 < row["interpolation_error"] < 0.2
    assert row["seconds"] > 0
    np.testing.assert_allclose(fine.x_full, x_full[-1])
    np.testing.assert_allclose(fine.x_reduced, x[-1], atol=1e-12)


def test_runs_together_are_those_alone(fine, chain, tiny_manifold, truth, made):
    other = replace(made, case=angle(34.0), xhat=0.9 * made.xhat)
    together, said = [other, made], []
    both = superresolve(
        tiny_manifold, chain.scene, [truth, truth], together, 3, FRAMES, device="cpu", say=said.append
    )
    (alone,) = superresolve(tiny_manifold, chain.scene, [truth], [other], 3, FRAMES, device="cpu")
    for found, expected in zip(both, (alone, fine), strict=True):
        measured = {name for name in found.row if not name.endswith("seconds")} - {"case"}
        for name in measured:
            assert found.row[name] == pytest.approx(expected.row[name], rel=1e-9, abs=1e-13)
        np.testing.assert_allclose(found.x_full, expected.x_full)
        np.testing.assert_allclose(found.x_reduced, expected.x_reduced, atol=1e-12)
    assert not np.allclose(alone.x_full, fine.x_full)
    assert [line.split(" in ")[0] for line in said] == [
        f"superresolve: friction_angle={value}°: 1,500 full-order particles" for value in (34, 26)
    ]


def test_a_tear_is_smeared(chain):
    """Two halves apart by 1 m: points left out at the tear land in between, others where they belong."""
    X = torch.tensor(chain.scene.refined(4).particles().X)
    moved = X + (X[:, :1] > 0.5) * torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)
    found = superresolution.interpolated(X[500:], X[:500], moved[None, :500])[0]
    apart = (found - moved[500:]).norm(dim=1)
    near = (X[500:, 0] - 0.5).abs() < 0.01
    assert apart[near].max() > 0.3
    assert apart[(X[500:, 0] - 0.5).abs() > 0.05].max() < 1e-6


def test_a_diverged_run_has_no_finite_error(chain, tiny_manifold, truth, made):
    lost = rollout_of(made.t, np.where(np.arange(25)[:, None] < 20, made.xhat, np.nan), diverged=20)
    (found,) = superresolve(tiny_manifold, chain.scene, [truth], [lost], 2, FRAMES, device="cpu")
    assert found.row["delta"] == found.row["particles_displacement_error"] == np.inf
    assert np.isfinite(found.x_reduced).all()  # its last good state, for pictures
    assert np.isfinite(found.row["interpolation_error"])


def test_a_run_by_the_full_order_solver_is_refused(chain, tiny_manifold, truth, made):
    handed = replace(made, by="full")
    with pytest.raises(ConfigError, match=r"took the run at .* deploy with fallback=none"):
        superresolve(tiny_manifold, chain.scene, [truth, truth], [made, handed], 2, FRAMES, device="cpu")
