"""What exporters are given: frames and points of a reduced run, decoded block by block."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch
from angles import angle
from decoded import whole

from nsf.data import Trajectory
from nsf.deployment import FULL_ORDER, Rollout
from nsf.errors import ConfigError, DeviceError, MissingRunError
from nsf.evaluation import metrics
from nsf.export import playback
from nsf.export.playback import Playback
from nsf.runs import Run


@pytest.fixture
def solver(chain, tiny_manifold):
    return chain.pipeline.solver_at(tiny_manifold, angle(26.0))


def test_blocks_are_what_the_solver_decodes(played, solver, deployed, monkeypatch):
    monkeypatch.setattr(playback, "POINTS", 64)
    shown = played()
    np.testing.assert_allclose(shown.t, np.array([0, 5, 10, 15, 20, 24]) * 0.005)
    xhat = torch.tensor(Rollout.open(deployed.path / "rollout_0.h5").xhat[[0, 5, 10, 15, 20, 24]])
    x, tau = whole(shown)
    decoder = solver.decoder()
    torch.testing.assert_close(x, decoder.position(xhat))
    torch.testing.assert_close(
        tau[..., [0, 1, 2, 1, 3, 4, 2, 4, 5]].unflatten(-1, (3, 3)), decoder.stress(xhat)
    )
    assert (shown.title, shown.name) == ("sand, friction angle=26°", "friction_angle_26")
    assert shown.floor == 0.13


def test_stress_from_the_deformation(pipeline_at, own_root, tiny_manifold):
    """stress=deformation affine=none: the law's stress, at the particles and in between."""
    pipeline = pipeline_at(own_root, "stress=deformation", "affine=none")
    run = pipeline.deploy()
    xhat = torch.tensor(Rollout.open(run.path / "rollout_0.h5").xhat[[0, 20, 24]])
    decoder = pipeline.solver_at(tiny_manifold, angle(26.0)).decoder()
    x, tau = whole(Playback(run, every=20, device="cpu"))
    torch.testing.assert_close(x, decoder.position(xhat))
    torch.testing.assert_close(tau, decoder.stress(xhat).flatten(2)[..., [0, 1, 2, 4, 5, 8]])
    more = Playback(run, every=20, points=600, device="cpu")
    _, between = whole(more)
    rows = [np.flatnonzero((more.X == X).all(1))[0] for X in tiny_manifold.X.numpy()[:20]]
    torch.testing.assert_close(between[:, rows], tau[:, :20], rtol=1e-4, atol=1e-2)


def test_fewer_points_are_particles(played, tiny_manifold):
    few = played(40)
    everything, _ = whole(played())
    rows = [int(np.flatnonzero((tiny_manifold.X.numpy() == X).all(1))[0]) for X in few.X]
    assert len(set(rows)) == 40
    torch.testing.assert_close(whole(few)[0], everything[:, rows])


def test_more_points_hold_the_particles(played, tiny_manifold, monkeypatch):
    monkeypatch.setattr(playback, "POINTS", 300)
    shown = played(1234)
    assert shown.X.shape == (1234, 3)
    rows = [int(np.flatnonzero((shown.X == X).all(1))[0]) for X in tiny_manifold.X.numpy()]
    x, tau = whole(shown)
    torch.testing.assert_close(x[:, rows], whole(played())[0], rtol=0, atol=1e-7)
    assert torch.isfinite(tau).all()
    assert shown.tops == played().tops  # colours do not depend on the number of points


def test_magnitudes(played):
    block = next(played(50).blocks())
    torch.testing.assert_close(block.magnitude("von_mises"), metrics.von_mises(block.tau))
    torch.testing.assert_close(block.magnitude("displacement"), (block.x - block.X).norm(dim=2))
    xx, yy, zz = (block.tau[..., k] for k in (0, 3, 5))
    torch.testing.assert_close(block.pressure, -(xx + yy + zz) / 3)


def spoiled(run, tmp_path, seal, **changes):
    """A copy of the tiny chain's runs whose rollout is another."""
    root = tmp_path / "runs"
    shutil.copytree(run.root, root)
    copy = Run.named(run.id, root=root)
    path = copy.path / "rollout_0.h5"
    rollout = replace(Rollout.open(path), **changes)
    rollout.save(path)
    seal(copy)
    return copy, rollout


def test_a_diverged_run_ends_before_it_is_lost(deployed, tmp_path, seal):
    run, _ = spoiled(deployed, tmp_path, seal, diverged=18)
    shown = Playback(run, every=5, device="cpu")
    np.testing.assert_allclose(shown.t, np.array([0, 5, 10, 15, 17]) * 0.005)
    assert shown.stopped == pytest.approx(0.09)


def test_a_run_by_the_full_order_solver_is_its_frames(deployed, chain, tmp_path, seal):
    one = Rollout.open(deployed.path / "rollout_0.h5")
    verdict = replace(one.verdict, error=np.zeros(1), bound=np.zeros(1))
    start = {name: getattr(one, name)[:1] for name in ("t", "xhat", "signal")} | {"verdict": verdict}
    start |= {"residuals": one.residuals[:0], "stops": [], "by": FULL_ORDER}
    run, _ = spoiled(deployed, tmp_path, seal, **start)
    shutil.copyfile(chain.trajectory(26.0), run.path / "continuation_0.h5")
    seal(run, "continuation_0.h5")
    shown = Playback(run, every=5, device="cpu")
    np.testing.assert_allclose(shown.t, np.array([0, 5, 10, 15, 20, 24]) * 0.005)
    with Trajectory.open(chain.trajectory(26.0)) as truth:
        np.testing.assert_allclose(whole(shown)[0][1:], truth.read("x")[[5, 10, 15, 20, 24]], atol=1e-6)
    with pytest.raises(ConfigError, match=r"full-order solver took this run.* fallback=none"):
        Playback(run, points=501, device="cpu")


def test_the_run_and_its_training_are_enough(deployed, tmp_path):
    shutil.copytree(deployed.root, tmp_path / "runs")
    shutil.rmtree(tmp_path / "runs/simulate")
    run = Run.named(deployed.id, root=tmp_path / "runs")
    for points in (100, 600):
        assert len(whole(Playback(run, points=points, device="cpu"))[0]) == 25
    shutil.rmtree(tmp_path / "runs/train")
    with pytest.raises(MissingRunError, match=r"train/sand.* is not there"):
        Playback(run, device="cpu")


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"points": 0}, "points=0 must be a whole number of at least 1"),
        ({"points": -5}, "points=-5"),
        ({"every": 0}, "every=0"),
        ({"fps": 0.0}, "fps=0"),
        ({"fps": float("nan")}, "fps=nan"),
        ({"color": "red"}, "color=red is unknown; choose von_mises or displacement"),
        (
            {"parameter": 27.0},
            r"27.0 was not deployed; choose one of 26, or .*scene\.design\.test",
        ),
        ({"parameter": "E=1"}, r"parameter=E=1 was not deployed; choose one of 26, or"),
    ],
)
def test_refused(deployed, options, told):
    with pytest.raises(ConfigError, match=told):
        Playback(deployed, device="cpu", **options)


def test_an_unknown_device_is_refused(deployed):
    with pytest.raises(DeviceError, match="device=tpu"):
        Playback(deployed, device="tpu")
