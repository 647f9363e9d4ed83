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


def test_report_keeps_the_rows_of_other_scenes(tmp_path, monkeypatch, tiny):
    monkeypatch.setattr(convergence, "load_scene", lambda name, overrides: tiny)
    for name in ("sand", "bread"):
        convergence.converge(tmp_path / "convergence", {"scenes": name}, str)
    frame = pd.read_csv(tmp_path / "convergence/convergence.csv")
    assert list(frame["scene"]) == ["bread", "sand"]
    assert (frame[["half", "third", "sampling", "sampling_stress"]] > 0.0).all(axis=None)
