"""Many runs by a recurrence, and whole ones, on the tiny chain; what they take is asserted nowhere."""

import shutil

import pandas as pd
import pytest
import torch
from angles import angle

from nsf.bench import whole
from nsf.bench.measure import taught as taught_by
from nsf.bench.recurrence import Many, measured
from nsf.bench.report import wide
from nsf.bench.rows import Measurements, Settings

TAUGHT = (
    "model=recurrence", "model.runs=3", "model.stride=2", "model.members=2", "model.descents=60",
    "model.width=16",
)  # fmt: skip


@pytest.fixture(scope="module")
def taught(chain, pipeline_at, tmp_path_factory):
    """The tiny chain by a recurrence, and rows of many runs."""
    root = tmp_path_factory.mktemp("taught") / "runs"
    figures = Measurements(Settings((), ("fp32", "fp64"), "cpu", 2), lambda line: None)
    for stage in ("simulate", "train"):
        shutil.copytree(chain.root / stage, root / stage)
    pipeline = pipeline_at(root, *TAUGHT)
    taught_by(pipeline)
    measured(pipeline, 3, figures)
    return pipeline, wide(figures.frame)


@pytest.fixture(scope="module")
def evaluated(taught):
    """Errors of the chain's first run."""
    pipeline, _ = taught
    pipeline.deploy()
    pipeline.evaluate()
    return pd.read_csv(pipeline.evaluation.path / "results.csv").iloc[0]


def test_each_precision_has_a_row(taught, evaluated):
    _, rows = taught
    assert rows["case"].tolist() == ["recurrence_batch3"] * 2
    assert (rows["precision"].tolist(), rows["batch"].tolist()) == (["fp32", "fp64"], [3, 3])
    assert rows["δ"][1] == pytest.approx(evaluated["delta"], rel=1e-6)
    assert rows["memory of the runs [MiB]"][1] > rows["memory of the runs [MiB]"][0]


def test_many_runs_are_those_of_a_batch(taught):
    pipeline, _ = taught
    cases, manifold = list(map(angle, (26.0, 23.5, 37.0))), pipeline.manifold()
    batch = pipeline.batch_at(manifold, cases)
    batch.step(24)
    many = Many(pipeline.recurrence(), batch.runs[0], cases)
    for _ in range(2):
        many.restart()
        many.step(10)
        many.step(14)
        torch.testing.assert_close(many.xhat, batch.batch.record.xhat, rtol=0, atol=1e-13)
    assert (many.xhat[0] - many.xhat[2]).abs().max() > 1e-3


@pytest.fixture(scope="module")
def whole_runs(taught):
    """Rows of whole runs of the tiny chain."""
    pipeline, _ = taught
    figures = Measurements(Settings((), ("fp32", "fp64"), "cpu", 2), lambda line: None)
    whole.measured(pipeline, figures)
    return wide(figures.frame).set_index(["case", "precision"])


def test_whole_runs_take_turns_with_both_precisions_and_a_coarse_grid(whole_runs):
    names = [("full_order", p) for p in ("fp32", "fp64")]
    names += [(kind, "fp32") for kind in ("coarse", "recurrence")]
    rows = [(f"{kind}_sand_500", precision) for kind, precision in names]
    parts = [(f"recurrence_sand_500_{end}", "fp32") for end in ("no_error_bar", "not_decoded")]
    assert set(whole_runs.index) == {*rows, *parts}
    assert (whole_runs["run [ms]"] > 0).all()
    own = whole_runs.loc[("recurrence_sand_500", "fp32")]
    for kind, precision in names[:3]:
        ratio = whole_runs.loc[(f"{kind}_sand_500", precision), "run [ms]"] / own["run [ms]"]
        assert own[f"time of {kind.replace('_', ' ')} {precision} over it"] == pytest.approx(ratio)


def test_errors_of_whole_runs_are_of_displacements(whole_runs, evaluated):
    error = whole_runs.loc[("recurrence_sand_500", "fp32"), "error"]
    assert 0.3 * evaluated["displacement_error"] < error < 3 * evaluated["displacement_error"]
    assert whole_runs.loc[("coarse_sand_500", "fp32"), "error"] > 0
    assert whole_runs.loc[("recurrence_sand_500", "fp32"), "first frame [s]"] > 0


def test_another_size_is_as_long_a_run_on_a_finer_grid():
    figures = Measurements(Settings((), ("fp32",), "cpu", 2), lambda line: None)
    chain = whole.quick_chain("sand", 12_000, figures)
    plain = whole.quick_chain("sand", None, figures).scene
    assert chain.scene.particle_count == 12_000
    assert chain.scene.steps % 10 == 0
    assert chain.scene.steps * chain.scene.dt == pytest.approx(plain.steps * plain.dt)
    assert chain.scene.dx < plain.dx
    assert (len(chain.split.train), len(chain.split.validation), len(chain.split.test)) == (6, 1, 1)
