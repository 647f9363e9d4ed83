"""`nsf bench benches=recurrence` on the tiny chain; what a step takes is asserted nowhere."""

import shutil

import numpy as np
import pandas as pd
import pytest
import torch
from angles import angle

from nsf.bench.recurrence import Many, measured, measured_decoded
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
    measured_decoded(pipeline, 1200, found)
    return pipeline, wide(found.frame), said


def test_every_case_has_a_row(taught):
    _, rows, _ = taught
    cases = ["full_order_sand", "recurrence_sand", "recurrence_batch3"]
    assert rows["case"].tolist() == 2 * cases + 2 * ["full_order_1k", "recurrence_1k"]
    assert rows["precision"].tolist() == 3 * ["fp32"] + 3 * ["fp64"] + 2 * ["fp32"] + 2 * ["fp64"]
    assert rows["particles"].tolist() == 6 * [500] + 4 * [1200]
    own, full = (rows[rows["case"].str.startswith(kind)] for kind in ("recurrence", "full_order"))
    assert own["batch"].tolist() == [1, 3, 1, 3, 1, 1]
    for name in ("sample", "δ", "speed-up", "memory of a run [MiB]", "teaching [s]"):
        assert own[name].notna().all()
        assert full[name].isna().all()
    alone = [True, False, True, False, True, True]
    assert own["decoding of a frame [ms]"].notna().tolist() == alone
    ratios = full["step [ms]"].to_numpy()[[0, 0, 1, 1, 2, 3]] / own["step [ms]"]
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
    # Another body, by its grid; see the same bound in test_bench.
    assert double["recurrence_1k"] < 0.03


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
