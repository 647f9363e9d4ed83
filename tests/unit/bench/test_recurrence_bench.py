"""`nsf bench benches=recurrence` on the tiny chain; what a step takes is asserted nowhere."""

import shutil

import numpy as np
import pandas as pd
import pytest
import torch
from angles import angle

from nsf.bench import whole
from nsf.bench.recurrence import Many, measured
from nsf.bench.report import wide
from nsf.bench.rows import Measurements, Settings

TAUGHT = (
    "model=recurrence", "model.runs=3", "model.stride=2", "model.members=2", "model.descents=60",
    "model.width=16",
)  # fmt: skip


@pytest.fixture(scope="module")
def taught(chain, pipeline_at, tmp_path_factory):
    """The tiny chain by a recurrence, its rows, and what was said of them."""
    root, said = tmp_path_factory.mktemp("taught") / "runs", []
    found = Measurements(Settings((), ("fp32", "fp64"), "cpu", 2), said.append)
    for stage in ("simulate", "train"):
        shutil.copytree(chain.root / stage, root / stage)
    pipeline = pipeline_at(root, *TAUGHT)
    measured(pipeline, found, many=3)
    return pipeline, wide(found.frame), said


def test_every_case_has_a_row(taught):
    _, rows, _ = taught
    cases = ["full_order_sand", "recurrence_sand", "recurrence_batch3"]
    assert rows["case"].tolist() == 2 * cases
    assert rows["precision"].tolist() == 3 * ["fp32"] + 3 * ["fp64"]
    assert rows["particles"].tolist() == 6 * [500]
    own, full = (rows[rows["case"].str.startswith(kind)] for kind in ("recurrence", "full_order"))
    assert own["batch"].tolist() == [1, 3, 1, 3]
    for name in ("sample", "δ", "speed-up", "memory of a run [MiB]", "teaching [s]"):
        assert own[name].notna().all()
        assert full[name].isna().all()
    ratios = full["step [ms]"].to_numpy()[[0, 0, 1, 1]] / own["step [ms]"]
    np.testing.assert_allclose(own["speed-up"], ratios)
    assert (own["runs that taught it"] == 6).all()


def test_delta_is_that_of_the_evaluation(taught):
    pipeline, rows, _ = taught
    pipeline.deploy()
    pipeline.evaluate()
    evaluated = pd.read_csv(pipeline.evaluation.path / "results.csv")["delta"][0]
    double = rows[rows["precision"] == "fp64"].set_index("case")["δ"]
    assert double["recurrence_sand"] == pytest.approx(evaluated, rel=1e-6)
    assert double["recurrence_batch3"] == pytest.approx(evaluated, rel=1e-6)


def test_a_run_holds_little(taught):
    pipeline, rows, _ = taught
    run = pipeline.solver_at(pipeline.manifold(), angle(26.0))
    own = rows[(rows["case"] == "recurrence_sand") & (rows["precision"] == "fp64")].iloc[0]
    assert own["memory of a run [MiB]"] == run.nbytes / 2**20
    assert run.nbytes < 0.3 * run.decoder().at.nbytes
    more = rows[(rows["case"] == "recurrence_batch3") & (rows["precision"] == "fp64")].iloc[0]
    assert more["memory of a run [MiB]"] < 3 * own["memory of a run [MiB]"]


def test_many_runs_are_those_of_a_batch(taught):
    pipeline, _, _ = taught
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
    pipeline, _, _ = taught
    figures = Measurements(Settings((), ("fp32", "fp64"), "cpu", 2), lambda line: None)
    whole.measured(pipeline, figures, pipeline.held_out[0])
    return wide(figures.frame).set_index(["case", "precision"])


def test_whole_runs_take_turns_with_both_precisions_and_a_coarse_grid(whole_runs):
    names = [("full_order", p) for p in ("fp32", "fp64")]
    names += [(kind, "fp32") for kind in ("coarse", "recurrence")]
    rows = [(f"{kind}_sand_500", precision) for kind, precision in names]
    assert set(whole_runs.index) == {*rows, ("recurrence_sand_500_no_error_bar", "fp32")}
    assert (whole_runs["run [ms]"] > 0).all()
    own = whole_runs.loc["recurrence_sand_500", "fp32"]
    for kind, precision in names[:3]:
        ratio = whole_runs.loc[(f"{kind}_sand_500", precision), "run [ms]"] / own["run [ms]"]
        assert own[f"time of {kind.replace('_', ' ')} {precision} over it"] == pytest.approx(ratio)


def test_errors_of_whole_runs_are_of_displacements(whole_runs, taught):
    pipeline, _, _ = taught
    evaluated = pd.read_csv(pipeline.evaluation.path / "results.csv").iloc[0]
    error = whole_runs.loc[("recurrence_sand_500", "fp32"), "error"]
    assert 0.3 * evaluated["displacement_error"] < error < 3 * evaluated["displacement_error"]
    assert whole_runs.loc[("coarse_sand_500", "fp32"), "error"] > 0
    assert whole_runs.loc[("recurrence_sand_500", "fp32"), "error bar"] > 0
    assert whole_runs.loc[("recurrence_sand_500", "fp32"), "first frame [s]"] > 0


def test_another_size_is_as_long_a_run_on_a_finer_grid():
    figures = Measurements(Settings((), ("fp32",), "cpu", 2), lambda line: None)
    chain, values = whole.quick_chain("sand", 12_000, figures)
    plain = whole.quick_chain("sand", None, figures)[0].scene
    assert (chain.scene.particle_count, values) == (12_000, [26.0])
    assert chain.scene.steps % 10 == 0
    assert chain.scene.steps * chain.scene.dt == pytest.approx(plain.steps * plain.dt)
    assert chain.scene.dx < plain.dx
    assert (len(chain.split.train), len(chain.split.validation), len(chain.split.test)) == (6, 1, 0)
