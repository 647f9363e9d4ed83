"""A distrusted reduced run goes on at full order."""

from dataclasses import replace

import numpy as np
import pytest
from angles import angle, rollout

from nsf.data import Trajectory
from nsf.deployment import go_on, hand_over
from nsf.errors import InstabilityError
from nsf.mpm import FP64, FullOrderMPM


@pytest.fixture(scope="module")
def solver(chain, tiny_manifold):
    return chain.pipeline.solver_at(tiny_manifold, angle(26.0), "cpu")


@pytest.fixture(scope="module")
def made(solver, tiny_trust):
    return rollout(solver, angle(26.0), tiny_trust)


@pytest.fixture(scope="module")
def truth(chain):
    with Trajectory.open(chain.trajectory(26.0)) as trajectory:
        yield trajectory


def test_at_the_start_it_is_the_full_order_run(solver, made, truth, tmp_path):
    go_on(solver, replace(made, handed_over=0), tmp_path / "rest.h5")
    with Trajectory.open(tmp_path / "rest.h5") as rest:
        assert (rest.frames, rest.parameters, rest.x_sha256) == (25, truth.parameters, truth.x_sha256)
        for name in ("x", "v", "C", "tau"):
            np.testing.assert_array_equal(rest.read(name), truth.read(name))


def test_the_state_is_the_decoded_one(solver, made):
    full, decoder = hand_over(solver, replace(made, handed_over=12)), solver.decoder()
    assert full.steps_taken == 12
    assert full.time == pytest.approx(made.t[12])
    latents = solver.xhat.new_tensor(made.xhat[11:13])
    state, (before, x) = full.state.numpy(), decoder.position(latents).numpy()
    tau = decoder.stress(latents[1:])[0].numpy()
    np.testing.assert_allclose(state["x"], x, atol=1e-14)
    np.testing.assert_allclose(state["v"], (x - before) / solver.dt, atol=1e-12)
    np.testing.assert_allclose(state["tau"], tau, atol=1e-12 * np.abs(tau).max())
    # Hencky's law: ε = log V carries τ.
    lam, mu = full.constants.lam[0], full.constants.mu[0]
    stretches, axes = np.linalg.eigh(state["F_e"])
    eps = np.log(stretches)
    principal = 2.0 * mu * eps + lam * eps.sum(1, keepdims=True)
    carried = (axes * principal[:, None, :]) @ axes.transpose(0, 2, 1)
    np.testing.assert_allclose(carried, tau, atol=1e-10 * np.abs(tau).max())


def test_mass_and_momentum_go_over(solver, made, truth, tmp_path):
    """As far as the decoded fields have them: compared with the truth at that time and one step on."""
    go_on(solver, replace(made, handed_over=12), tmp_path / "rest.h5", FP64)
    with Trajectory.open(tmp_path / "rest.h5") as rest:
        assert rest.frames == 13
        np.testing.assert_allclose(rest.t, truth.t[12:])
        np.testing.assert_array_equal(rest.mass, truth.mass)
        v, v_true = rest.read("v"), truth.read("v", frames=slice(12, None))
        p, p_true = ((truth.mass[:, None] * u).sum(1) for u in (v, v_true))
        scale = (truth.mass * np.linalg.norm(v_true, axis=2)).sum(1)
        assert (np.linalg.norm(p - p_true, axis=1) / scale).max() < 0.05
        # Nothing kicks: the first full-order step changes the momentum as the truth's own does.
        kick = np.linalg.norm((p[1] - p[0]) - (p_true[1] - p_true[0]))
        assert kick < 0.05 * scale[0]
        x, x_true = rest.read("x"), truth.read("x", frames=slice(12, None))
        moved = np.linalg.norm(x_true - truth.X, axis=(1, 2))
        assert (np.linalg.norm(x - x_true, axis=(1, 2)) / moved).max() < 0.1


def test_lost_stability_is_said_clearly(solver, made, tmp_path):
    xhat = made.xhat.copy()
    xhat[11] += 1e3  # the backward difference gives absurd velocities
    broken = replace(made, xhat=xhat, handed_over=12)
    with pytest.raises(InstabilityError, match=r"friction_angle.*26.*at t = 0\.06 s, which lost stability"):
        go_on(solver, broken, tmp_path / "rest.h5")
    assert not list(tmp_path.iterdir())


def test_a_run_lost_at_its_end_leaves_no_file(solver, made, tmp_path, monkeypatch):
    def check(full):
        if full.steps_taken == 24:
            raise InstabilityError("off the grid")

    def seldom_checked(*arguments):
        full = hand_over(*arguments)
        full.check_every = 100  # so that the last check is the one after the last step
        return full

    monkeypatch.setattr(FullOrderMPM, "check", check)
    monkeypatch.setattr("nsf.deployment.fallback.hand_over", seldom_checked)
    with pytest.raises(InstabilityError, match="lost stability: off the grid"):
        go_on(solver, replace(made, handed_over=12), tmp_path / "rest.h5")
    assert not list(tmp_path.iterdir())
