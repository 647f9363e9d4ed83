"""Scenes on finer grids, as `nsf validate scenes=…` runs them."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

import nsf
from nsf.validation import convergence


@pytest.fixture
def tiny():
    """Sand of few particles, for a few steps."""
    scene = nsf.load_scene("sand").resampled(100)
    return replace(scene, steps=5)


@pytest.mark.parametrize("p", [0.7, 1.0, 2.0])
def test_order_of_errors_that_have_one(p):
    half, third = (1.0 - factor**-p for factor in (2.0, 3.0))
    assert convergence.observed_order(half, third) == pytest.approx(p)


@pytest.mark.parametrize("third", [0.9, 1.7])
def test_no_order_where_a_finer_grid_is_nearer_or_far_off(third):
    assert np.isnan(convergence.observed_order(1.0, third))


def test_particles_of_a_finer_run_begin_with_those_of_the_scene(tiny):
    finer = tiny.coarsened(0.5, 0.5)
    assert (finer.dx, finer.steps, finer.particle_count) == (tiny.dx / 2.0, 10, 800)
    shared = convergence.run(finer, "cpu", tiny)
    assert np.array_equal(shared.X, tiny.particles().X)
    assert max(convergence.run(tiny, "cpu").distances(shared)) > 0.0


def test_a_second_sampling_has_other_particles_of_the_same_body(tiny):
    other = convergence.second_sampling(tiny).particles()
    ours = tiny.particles()
    assert other.mass == pytest.approx(ours.mass)
    assert np.linalg.norm(ours.X[:, None] - other.X, axis=2).min() > 0.0


def test_last_frame_is_the_end_of_the_run_where_five_does_not_divide_the_steps(tiny):
    coarse = replace(tiny, steps=7)
    for scene in (coarse, coarse.coarsened(1.0, 1.0 / 3.0)):
        solver = scene.full_order()
        solver.step(scene.steps)
        frames = convergence.run(scene, "cpu", coarse)
        assert np.allclose(frames.x[-1], solver.state.numpy()["x"], rtol=0, atol=1e-12)


def test_frames_of_runs_are_at_the_same_times(tiny):
    """In free flight all runs fall as far, but for the error of the step."""
    coarse = replace(tiny, steps=32, dt=tiny.dt / 8.0)
    runs = [convergence.run(scene, "cpu", coarse) for scene in (coarse, coarse.coarsened(1.0, 1.0 / 3.0))]
    fallen = [np.linalg.norm(frames.x[2] - frames.X) for frames in runs]
    assert fallen[0] == pytest.approx(fallen[1], rel=0.1)


def test_no_order_where_other_particles_do_more_than_the_cell(tmp_path):
    row = {"scene": "sand", "scale": "small", "half": 0.5, "third": 2.0 / 3.0}
    frame = pd.DataFrame([row | {"sampling": 0.1}, row | {"sampling": 0.2}])
    full = convergence.completed(frame, tmp_path)
    assert full["order"][0] == pytest.approx(1.0)
    assert full["grid"][0] == pytest.approx(1.0)
    assert full.loc[1, ["order", "grid"]].isna().all()


def test_reduced_errors_are_of_small_scenes_and_of_the_table_as_it_is(tmp_path):
    row = {"scene": "sand", "half": 0.1, "third": 0.2, "sampling": 0.1}
    frame = pd.DataFrame([row | {"scale": scale} for scale in ("small", "paper")])
    reduced = {"report": "table1/small", "scene": "sand", "model": "projected", "stress_error": 0.2}
    for error in (0.3, 0.4):
        pd.DataFrame([reduced | {"displacement_error": error}]).to_csv(tmp_path / "results.csv")
        full = convergence.completed(frame, tmp_path)
        assert full["projected"][0] == error
        assert np.isnan(full["projected"][1])


def test_report_keeps_the_rows_of_other_scenes_and_scales(tmp_path, monkeypatch, tiny):
    monkeypatch.setattr(convergence, "load_scene", lambda name, overrides: tiny)
    for name, scale in (("sand,sand", "small"), ("bread", "small"), ("sand", "paper"), ("sand", "small")):
        convergence.converge(tmp_path / "convergence", {"scenes": name, "scale": scale}, str)
    frame = pd.read_csv(tmp_path / "convergence/convergence.csv")
    assert sorted(zip(frame["scene"], frame["scale"], strict=True)) == [
        ("bread", "small"), ("sand", "paper"), ("sand", "small"),
    ]  # fmt: skip
    assert frame["scene"][0] == "bread"
    assert "| sand, paper |" in (tmp_path / "convergence/index.md").read_text()
    assert (frame[["half", "third", "sampling", "sampling_stress"]] > 0.0).all(axis=None)
