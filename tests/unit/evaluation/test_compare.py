"""A rollout beside its full-order truth."""

import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
from angles import angle, rollout

import nsf
import nsf.scenes
from nsf.data import Trajectory
from nsf.deployment import FULL_ORDER, Rollout, Verdict
from nsf.dynamics import Sources
from nsf.errors import InstabilityError, SchemaError
from nsf.evaluation import at_frames, compare, metrics
from nsf.evaluation.compare import _shown, bound_at_frames

ERRORS = ["delta", "displacement_error", "stress_error"]


def rollout_of(t, xhat, diverged=-1):
    n = len(t) - 1
    none = np.zeros(n + 1)
    told = ["converged"] * n, none, Verdict(none, none, 1.0, 0.2)
    return Rollout(angle(26.0), t, xhat, np.zeros((n, 2)), *told, 20, 50.0, 0, 1.0, diverged)


@pytest.fixture(scope="module")
def comparison_of(chain, tiny_manifold, truth):
    def build(rollout, split="test", pictures=(50, 4), **options):
        solver = nsf.reduced(
            chain.scene, tiny_manifold, {"friction_angle": 26.0}, 20, device="cpu", **options
        )
        told = []
        found = compare(solver, truth, rollout, split, pictures, advance=told.append)
        assert sum(told) == truth.frames
        return found

    return build


@pytest.fixture(scope="module")
def perfect(tiny_manifold, truth, comparison_of):
    """The latents of the truth's own frames: a reduced run without dynamics."""
    xhat = tiny_manifold.encode(torch.tensor(truth.read("x"), dtype=torch.float64)).numpy()
    return comparison_of(rollout_of(truth.t, xhat))


def test_totals_are_the_metrics(comparison_of, made, tiny_manifold, truth):
    """Over frames 1..N, from positions and stresses decoded here, with nothing chunked."""
    everything, xhat = tiny_manifold.restrict(), torch.tensor(made.xhat)
    found = comparison_of(made)
    x, tau = (torch.tensor(truth.read(k), dtype=torch.float64) for k in ("x", "tau"))
    x_rom = everything.position(xhat)
    tau_rom = everything.stress(xhat, torch.tensor([26.0], dtype=torch.float64))
    assert found.delta == pytest.approx(metrics.deformation_error(x_rom[1:], x[1:]), rel=1e-9)
    expected = metrics.displacement_error(x_rom[1:], x[1:], torch.tensor(truth.X))
    assert found.displacement_error == pytest.approx(expected, rel=1e-9)
    assert found.stress_error == pytest.approx(metrics.stress_error(tau_rom[1:], tau[1:]), rel=1e-9)


def test_a_perfect_rollout_leaves_the_reconstruction_error(perfect):
    assert perfect.delta == pytest.approx(perfect.reconstruction_delta, rel=1e-9)
    assert perfect.stress_error == pytest.approx(perfect.reconstruction_stress_error, rel=1e-9)
    assert 0.0 < perfect.delta < 0.003


def test_the_rollout_is_worse_than_the_reconstruction(comparison_of, made, perfect):
    found = comparison_of(made)
    assert found.reconstruction_delta == perfect.reconstruction_delta
    assert perfect.delta < found.delta < 0.05
    assert found.displacement_error > 3.0 * found.delta


def test_chunks_change_nothing(comparison_of, made, monkeypatch):
    whole = comparison_of(made)
    # The package exports a function of the module's name.
    monkeypatch.setattr(sys.modules["nsf.evaluation.compare"], "frames_at_once", lambda *of: 4)
    pieces = comparison_of(made)
    np.testing.assert_allclose(
        pieces.series.drop(columns=["case", "split"]).to_numpy(),
        whole.series.drop(columns=["case", "split"]).to_numpy(),
        rtol=1e-9,
    )
    assert pieces.delta == pytest.approx(whole.delta, rel=1e-12)
    assert pieces.pictures.keys() == whole.pictures.keys()
    for name in (name for name, values in whole.pictures.items() if values.dtype.kind == "f"):
        values = whole.pictures[name]
        np.testing.assert_allclose(pieces.pictures[name], values, rtol=1e-6)


def test_series(comparison_of, made, truth):
    series = comparison_of(made).series
    latents = [f"{kind}_{k}" for kind in ("xhat", "encoded") for k in range(1, 5)]
    first = ["case", "split", "frame", "t"]
    assert list(series) == [*first, *ERRORS, "reconstruction_delta", "error_bound", *latents]
    assert len(series) == truth.frames == 25
    assert set(series["split"]) == {"test"}
    np.testing.assert_array_equal(series["t"], truth.t)
    np.testing.assert_allclose(series[[f"xhat_{k}" for k in range(1, 5)]], made.xhat, rtol=1e-12)
    assert np.isnan(series["displacement_error"][0])  # nothing has moved yet
    assert np.isfinite(series[ERRORS][1:]).all().all()
    errors = series["delta"][1:].to_numpy()
    assert errors.min() <= comparison_of(made).delta <= errors.max()


def test_a_ratio_to_hardly_anything_is_a_gap(made, comparison_of, monkeypatch):
    """The column has fallen by less than 30 % of its fall, say."""
    most = comparison_of(made).series
    monkeypatch.setattr(sys.modules[compare.__module__], "_HARDLY", 0.3)
    some = comparison_of(made).series
    gaps = some["displacement_error"].isna().to_numpy()
    assert 1 < gaps.sum() < len(gaps)
    assert np.array_equal(gaps, np.arange(len(gaps)) < gaps.sum())  # a falling column moves ever further
    np.testing.assert_array_equal(some["displacement_error"][~gaps], most["displacement_error"][~gaps])


def test_pictures(comparison_of, made, truth):
    kept = comparison_of(made, pictures=(50, 4)).pictures
    assert kept["x_full"].shape == kept["x_reduced"].shape == (4, 50, 3)
    assert kept["stress_full"].shape == kept["stress_reduced"].shape == (4, 50)
    np.testing.assert_allclose(kept["t"], truth.t[[0, 8, 16, 24]])
    whole = comparison_of(made, pictures=(10_000, 1000))
    many = whole.pictures
    off = np.linalg.norm(many["x_reduced"].astype(float) - many["x_full"], axis=2)
    assert whole.distance_max == pytest.approx(np.sqrt((off**2).mean(1)).max(), rel=1e-4)
    ends = [np.sort(many[kind][-1, :, 2])[[2, -3]] for kind in ("x_reduced", "x_full")]
    drop = np.ptp(ends[0]) - np.ptp(ends[1])
    assert whole.quantities["height"] == pytest.approx(drop, abs=2e-3)
    assert set(whole.quantities) == {"height", "run_out", "opening", "springback"}
    assert many["x_full"].shape == (25, 500, 3)
    np.testing.assert_allclose(many["x_full"], truth.read("x"), rtol=1e-6)
    tau = torch.as_tensor(np.asarray(truth.read("tau"))).double()
    np.testing.assert_allclose(many["stress_full"], metrics.von_mises(tau), rtol=1e-6)


def test_frames_between_deployment_steps():
    t = np.array([0.0, 1.5, 3.0])
    run = rollout_of(t, np.array([[0.0, 10.0], [3.0, 10.0], [9.0, 40.0]]))
    found = at_frames(run, np.array([0.0, 1.0, 2.0, 3.0]))
    np.testing.assert_allclose(found, [[0, 10], [2, 10], [5, 20], [9, 40]])


def test_frames_at_deployment_steps_are_exact(made):
    assert np.array_equal(at_frames(made, made.t), made.xhat)


def test_a_multiplied_step_is_compared_at_the_frames(chain, tiny_manifold, tiny_trust, comparison_of, made):

    value = {"friction_angle": 26.0}
    solver = nsf.reduced(chain.scene, tiny_manifold, value, 20, device="cpu", dt_multiplier=1.5)
    run = rollout(solver, angle(26.0), tiny_trust)
    found = comparison_of(run)
    assert len(found.series) == 25
    assert found.delta < 3.0 * comparison_of(made).delta + 0.005


@pytest.fixture(scope="module")
def lost(made, comparison_of):
    """A run that was lost at step 10."""
    xhat = made.xhat.copy()
    xhat[10:] = np.nan
    return comparison_of(replace(made, xhat=xhat, diverged=10))


def test_a_diverged_run_has_infinite_errors(lost):
    assert [lost.delta, lost.displacement_error, lost.stress_error] == [np.inf] * 3
    assert np.isfinite([lost.reconstruction_delta, lost.reconstruction_stress_error]).all()


@pytest.mark.parametrize("column", ERRORS)
def test_a_diverged_run_is_infinite_from_its_step_on(lost, column):
    values = lost.series[column].to_numpy()
    assert np.isfinite(values[1:10]).all()
    assert (values[10:] == np.inf).all()


def test_pictures_of_a_diverged_run_hold_its_last_state(lost):
    pictures = lost.pictures.items()
    assert all(np.isfinite(values).all() for name, values in pictures if name != "solid_shape")
    assert np.isfinite(lost.series["reconstruction_delta"]).all()


def test_pictures_of_a_lost_run_with_coordinates_of_stress_are_finite(comparison_of, made):
    xhat, stress = made.xhat.copy(), np.ones((len(made.t), 2))
    xhat[10:] = stress[9:] = np.nan
    stress[8] = 1e60  # beyond fp32, the step before it is lost
    found = comparison_of(replace(made, xhat=xhat, stress=stress, diverged=9))
    assert np.isfinite(found.pictures["stress_reduced"]).all()
    assert (found.pictures["stress_reduced"][-1] > 0.0).any()  # the last good state, not 0
    assert found.stress_error == np.inf


def test_a_run_lost_between_frames(comparison_of, made):
    """With a longer step, frames just before the lost one lie between a finite and a lost latent."""
    t, xhat = made.t[::2].copy(), made.xhat[::2].copy()
    xhat[5:] = np.nan
    lost = comparison_of(rollout_of(t, xhat, diverged=5))
    assert lost.delta == np.inf
    assert (lost.series["delta"][9:] == np.inf).all()
    assert np.isfinite(lost.series["delta"][:9]).all()


def test_a_run_lost_at_infinity(comparison_of, made):
    xhat = made.xhat.copy()
    xhat[7:, 0] = np.inf
    lost = comparison_of(replace(made, xhat=xhat, diverged=7))
    assert lost.delta == np.inf
    assert not lost.series[1:].drop(columns="error_bound").isna().any().any()


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_run_that_is_not_finite_and_does_not_say_so_has_no_errors(made, comparison_of, bad):
    xhat = made.xhat.copy()
    xhat[7, 0] = bad
    with pytest.raises(InstabilityError, match=r"delta=nan at friction_angle=26° is no error"):
        comparison_of(replace(made, xhat=xhat))


def test_stress_that_is_not_finite_is_as_far_off_as_can_be(made, comparison_of, monkeypatch):
    """As of the law of a body that is turned inside out; where the body is, is known all the same."""
    comparing = sys.modules["nsf.evaluation.compare"]
    whole, fields = comparison_of(made), comparing._fields

    def broken(*args):
        x, tau = fields(*args)
        tau[5, 7] = torch.nan
        return x, tau

    monkeypatch.setattr(comparing, "_fields", broken)
    found = comparison_of(made)
    assert found.stress_error == found.series["stress_error"][5] == np.inf
    assert np.isfinite(found.series["stress_error"].drop(5)[1:]).all()
    assert (found.delta, found.distance_max) == (whole.delta, whole.distance_max)
    assert np.isfinite(found.pictures["stress_reduced"]).all()


def test_a_truth_that_never_moves_has_no_displacement_error(made, comparison_of, truth, monkeypatch):
    plain = Trajectory.read

    def still(self, field, *args, **options):
        found = plain(self, field, *args, **options)
        return np.broadcast_to(self.X, found.shape).copy() if field == "x" else found

    monkeypatch.setattr(Trajectory, "read", still)
    with pytest.raises(InstabilityError, match=r"displacement_error=inf at friction_angle=26° is no error"):
        comparison_of(made)


def test_a_method_is_held_to_the_stress_it_used(comparison_of, made, chain, tiny_manifold, truth):
    """Without a stress field τ is that of ∂g/∂X."""
    neural = comparison_of(made)
    baseline = comparison_of(made, sources=Sources("deformation", "none"))
    law = chain.scene.material
    at, F = tiny_manifold.restrict(), []
    for row in torch.tensor(made.xhat):
        F.append(at.deformation_gradient(row))
    tau_fom = torch.tensor(truth.read("tau"), dtype=torch.float64)
    U, sigma, _ = torch.linalg.svd(torch.stack(F))
    eps = sigma.log()
    principal = 2 * law.mu * eps + law.lam * eps.sum(-1, keepdim=True)
    tau = (U * principal[..., None, :]) @ U.mT
    tau6 = torch.stack([tau[..., i, j] for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))], -1)
    assert baseline.stress_error == pytest.approx(metrics.stress_error(tau6[1:], tau_fom[1:]), rel=1e-6)
    assert baseline.stress_error != pytest.approx(neural.stress_error, rel=1e-2)
    assert baseline.delta == pytest.approx(neural.delta, rel=1e-12)


def test_stress_that_particles_carried_is_what_counts(chain, tiny_manifold, truth):
    """With `stress=particles affine=particles`, in chunks of any length, though the fields say otherwise."""
    sources = Sources("particles", "particles")

    def solver():
        options = {"sources": sources, "device": "cpu"}
        return nsf.reduced(chain.scene, tiny_manifold, {"friction_angle": 26.0}, 20, **options)

    run, carried = solver(), []
    for _ in range(len(truth.t) - 1):
        run.step()
        tau = np.empty((len(run.state), 3, 3))
        tau[run.span.order] = run.span.tau.numpy()
        carried.append(tau[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]])
    rollout = rollout_of(truth.t, run.record.xhat.numpy().copy())
    full = truth.read("tau").astype(float)
    expected = metrics.stress_error(torch.tensor(np.stack(carried)), torch.tensor(full[1:]))
    found = compare(solver(), truth, rollout, "test", (50, 4))
    assert found.stress_error == pytest.approx(expected, rel=1e-9)
    plain = nsf.reduced(chain.scene, tiny_manifold, {"friction_angle": 26.0}, 20, device="cpu")
    decoded = compare(plain, truth, rollout, "test", (50, 4))
    assert found.stress_error != pytest.approx(decoded.stress_error, rel=1e-2)
    assert found.delta == pytest.approx(decoded.delta, rel=1e-12)
    assert found.series["stress_error"].isna().iloc[0]  # nothing is loaded at t = 0


def test_other_particles_are_refused(chain, tiny, tiny_manifold, made, tmp_path):
    solver = nsf.reduced(chain.scene, tiny_manifold, {"friction_angle": 26.0}, 20, device="cpu")
    scene = nsf.load_scene("sand", [*tiny[1:], "scene.bodies.column.particles=499"])
    from nsf.data import TrajectoryWriter

    constants = scene.particles()
    about = {"mass": constants.mass, "volume0": constants.volume0, "parameters": {"friction_angle": 26.0}}
    zeros = {k: np.zeros((499, c)) for k, c in (("v", 3), ("C", 9), ("tau", 6))}
    writer = TrajectoryWriter(
        tmp_path / "t.h5", X=constants.X, **about, dt=0.005, dx=0.02, frames=1, dtype="float32"
    )
    with writer:
        writer.append(0.0, constants.X, **zeros)
    with (
        Trajectory.open(tmp_path / "t.h5") as other,
        pytest.raises(SchemaError, match="checkpoint made for other particles"),
    ):
        compare(solver, other, made, "test", (10, 2))


@pytest.fixture(scope="module")
def taken(made):
    """A run that the full-order solver took from its beginning."""
    start = {name: getattr(made, name)[:1] for name in ("t", "xhat", "signal")}
    return replace(made, **start, residuals=made.residuals[:0], stops=[], by=FULL_ORDER)


@pytest.mark.parametrize("chunk", [None, 4])
def test_a_run_by_the_full_order_solver_has_its_frames(
    taken, chunk, chain, tiny_manifold, truth, monkeypatch
):
    if chunk:
        monkeypatch.setattr(sys.modules["nsf.evaluation.compare"], "frames_at_once", lambda *of: chunk)
    solver = chain.pipeline.solver_at(tiny_manifold, angle(26.0), "cpu")
    comparison = compare(solver, truth, taken, "test", (500, 25), truth)
    assert comparison.series.loc[1:, ["delta", "displacement_error", "stress_error"]].max(axis=None) == 0.0
    np.testing.assert_allclose(comparison.pictures["x_reduced"][1:], truth.read("x")[1:], rtol=1e-6)
    assert comparison.series.loc[1:, ["error_bound", "xhat_1"]].isna().all().all()


def test_such_frames_must_be_there(taken, chain, tiny_manifold, truth):
    solver = chain.pipeline.solver_at(tiny_manifold, angle(26.0), "cpu")
    with pytest.raises(SchemaError, match=r"took the run at .*, and its 25 frames are not there"):
        compare(solver, truth, taken, "test", (10, 2), None)


def test_bounds_at_frames_between_deployment_steps(made):
    bound = np.array([0.0, 0.5, np.inf])
    run = replace(made, t=np.array([0.0, 1.5, 3.0]), verdict=replace(made.verdict, bound=bound))
    at_frames_ = bound_at_frames(run, np.array([0.0, 1.0, 1.5, 2.0, 3.0]))
    np.testing.assert_array_equal(at_frames_, [0.0, 0.5, 0.5, np.inf, np.inf])


@pytest.mark.parametrize(("most", "kept"), [(30, 20), (20, 20), (8, 8)])
def test_pictures_have_the_sample_and_others_by_chance(most, kept):
    sample = np.repeat(np.arange(100, 120), 2)  # a particle that counts twice
    shown = _shown(500, most, sample)
    assert len(shown) == len(np.unique(shown)) == most
    assert (np.diff(shown) > 0).all()
    assert np.isin(shown, sample).sum() == kept
    assert np.ptp(shown[np.isin(shown, sample)]) > 9  # no end of S alone, where S has too many
