"""`data.every`: runs of which only some frames are stored, and what is trained and compared on these."""

import numpy as np
import pandas as pd
import pytest
import torch

from nsf.data import Snapshots, Trajectory
from nsf.data.schema import COMPONENTS, TRAJECTORY
from nsf.deployment import Rollout
from nsf.errors import ConfigError
from nsf.evaluation import compare
from nsf.recurrence import RecurrenceEngine

EVERY = 4
THINNED = (f"data.every={EVERY}", "field.affine=rate", "evaluation.trials=0")
TAUGHT = (
    "model=recurrence", "model.runs=8", "model.stress=4", "model.stride=3", "model.members=1",
    "model.descents=30", "model.width=16", "scene.design.validation=[28]",
)  # fmt: skip


@pytest.fixture(scope="module")
def thinned(pipeline_at, tmp_path_factory):
    """The tiny chain of a recurrence whose runs store each fourth step."""
    pipeline = pipeline_at(tmp_path_factory.mktemp("thinned") / "runs", *THINNED, *TAUGHT)
    for stage in ("simulate", "train", "deploy", "evaluate"):
        pipeline.run(stage)
    return pipeline


@pytest.fixture(scope="module")
def each(thinned, chain):
    """A held-out run with each step, and the same one thinned."""
    files = chain.trajectory(26.0), thinned.truth(thinned.held_out[0]).file(TRAJECTORY)
    with Trajectory.open(files[0]) as whole, Trajectory.open(files[1]) as part:
        yield whole, part


def test_stored_frames_are_those_of_each_step(each):
    whole, part = each
    assert (whole.every, part.every, part.frames) == (1, EVERY, 7)
    np.testing.assert_array_equal(part.t, whole.t[::EVERY])
    for name in COMPONENTS:
        np.testing.assert_array_equal(part.read(name), whole.read(name, slice(None, None, EVERY)))
    for name, values in part.forcing.items():
        np.testing.assert_array_equal(values, whole.forcing[name][::EVERY])


def test_rates_are_those_of_a_step(thinned, chain):
    manifold = thinned.manifold()
    with Trajectory.open(chain.trajectory(22.0)) as whole:
        xhat = manifold.encode(torch.as_tensor(whole.read("x")))
    rates = torch.diff(xhat, dim=0)[EVERY - 1 :: EVERY] / thinned.scene.dt
    off = manifold.training_rates[1:7] - rates  # positions are stored in float32
    assert (off.norm(dim=0) < 1e-3 * rates.norm(dim=0)).all()


def test_modes_of_thinned_runs_are_nearly_those_of_each_step(thinned, chain, tiny_manifold):
    """Projected onto 8 modes, all frames of the training runs lose hardly more."""
    snapshots = Snapshots([chain.trajectory(value) for value in (22.0, 30.0, 38.0)])

    def lost(manifold):
        parts = []
        for phase, name in (("deformation", "x"), ("stress", "tau")):
            field, values = manifold.fields[phase], snapshots.slab(name, slice(None)).double()
            apart = (values - field.mean - (snapshots.X if name == "x" else 0.0)).flatten(1)
            modes = field.modes.flatten(0, 1).double()
            parts.append(float((apart - apart @ modes @ modes.T).norm() / apart.norm()))
        return parts

    assert np.divide(lost(thinned.manifold()), lost(tiny_manifold)).max() < 1.1


def test_errors_are_those_of_each_step_at_the_stored_frames(thinned, each):
    """Momenta too, which need what a particle did in the step before a frame."""
    made = Rollout.open(thinned.deployment.file("rollout_0.h5"))
    solver, pictures = thinned.solver_at(thinned.manifold(), thinned.held_out[0]), (50, 3)
    whole, part = (compare(solver, truth, made, "test", pictures).series for truth in each)
    names = [name for name in part.columns if part[name].dtype == float]
    np.testing.assert_allclose(part[names], whole[names].iloc[::EVERY], rtol=1e-6, atol=1e-9)
    assert len(part) == 7


def test_a_recurrence_is_taught_each_step(thinned):
    taught = RecurrenceEngine.load(thinned.taught.file("recurrence.pt"))
    assert taught.form.stride == 3
    assert thinned.taught.manifest["metrics"]["streamed"] == 11  # those of training are made once more
    assert np.isfinite(thinned.taught.manifest["metrics"]["errors"]).all()


def test_a_full_order_run_has_no_error(thinned, pipeline_at):
    full = pipeline_at(thinned.root, *THINNED, "model=full")
    for stage in ("deploy", "evaluate"):
        full.run(stage)
    row = pd.read_csv(full.evaluation.path / "results.csv").iloc[0]
    assert row["displacement_error"] == 0.0


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["data.every=5"], "data.every=5 does not divide the 24 steps of a run; set data.every=4"),
        (["data.every=4", "model=interpolate"], "set data.every=1"),
        (["data.every=4", "sampler=cubature"], "set data.every=1, or sampler=random"),
    ],
)
def test_what_needs_each_step_is_refused(pipeline_at, tmp_path, overrides, message):
    with pytest.raises(ConfigError, match=message):
        pipeline_at(tmp_path, *overrides).check()
