"""`nsf bench`: rows, passes and the report; what a step takes is asserted nowhere."""

import re

import numpy as np
import pandas as pd
import pytest
import torch
from angles import angle

from nsf import config
from nsf.bench import bench
from nsf.bench.batch import _too_large, cases_of
from nsf.bench.batch import measured as measured_batches
from nsf.bench.full_order import collapse, pass_times
from nsf.bench.measure import WholeRun, bandwidth, build, turns, window_times
from nsf.bench.reduced import measured as measured_chain
from nsf.bench.reduced import measured_networks
from nsf.bench.report import (
    step_over_batch,
    wide,
    write_report,
)
from nsf.bench.rows import COLUMNS, FILE, Measurements, Settings, read
from nsf.bench.scaling import at_size, carried_over
from nsf.bench.scaling import measured as measured_sizes
from nsf.bench.training import measured as measured_training
from nsf.cli import main
from nsf.errors import ConfigError, DeviceError, SchemaError, StorageError
from nsf.pipeline import Pipeline

SMALL = {"benches": "full_order", "particles": "200,500", "trials": "2", "device": "cpu", "precision": "fp32"}
PASSES = ["clear", "p2g", "grid", "g2p_stress"]


def measurements(*precisions, trials=2):
    """A table to fill, and what was said of it."""
    said: list[str] = []
    return Measurements(Settings((), precisions, "cpu", trials), said.append), said


def of(rows, what, case=None):
    """Medians of one figure of the whole steps, by case and precision in the order measured."""
    rows = rows[(rows["what"] == what) & (rows["part"] == "")]
    return rows if case is None else rows[rows["case"] == case]["median"].tolist()


def again(chain):
    """A chain of the same runs."""
    return Pipeline(chain.pipeline.config, say=lambda line: None, root=chain.root)


def reported(rows, folder):
    """The page of some rows, and the pictures in it."""
    rows.to_csv(folder / FILE, index=False)
    page = write_report(folder).read_text()
    return page, re.findall(r"\]\((.*?)\)", page)


def test_a_table_of_something_else_is_refused(tmp_path):
    (tmp_path / FILE).write_text("bench,case\nfull_order,first\n")
    with pytest.raises(SchemaError, match="lacks the columns particles"):
        read(tmp_path / FILE)


@pytest.fixture(scope="module", autouse=True)
def known_bandwidth():
    """A copy of 1 GB/s, whose measurement takes a second; a test of it asks it anew."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("nsf.bench.full_order.bandwidth", lambda device: 1e9)
        yield


@pytest.fixture(scope="module")
def speed(known_bandwidth, tmp_path_factory):
    """The folder of a report of one benchmark."""
    folder = tmp_path_factory.mktemp("speed")
    bench(folder, SMALL, lambda text: None)
    return folder


def test_a_benchmark_gives_its_rows(speed):
    rows = read(speed / FILE)
    assert list(rows) == list(COLUMNS)
    steps = of(rows, "step")
    assert steps["case"].tolist() == ["full_order_200", "full_order_500"]
    assert ((steps["p10"] <= steps["median"]) & (steps["median"] <= steps["p90"])).all()
    assert (of(rows, "peak memory")["median"] > 0).all()
    times = rows[(rows["part"] != "") & (rows["what"] == "time")]
    assert times.groupby("case", sort=False)["part"].apply(list).tolist() == [PASSES] * 2
    passes = wide(rows[rows["part"] != ""])
    np.testing.assert_allclose(
        passes["bandwidth [GB/s]"], passes["moved [MiB]"] * 2**20 / passes["time [ms]"] / 1e6
    )


def test_other_rows_are_kept(speed, tmp_path, monkeypatch):
    before = read(speed / FILE)
    elsewhere = before.assign(device="NVIDIA H200", median=before["median"] + 0.1234567890123)
    other = before.iloc[:1].assign(bench="scaling", commit="old")
    stale = before.assign(median=1e9, commit="old")
    pd.concat([stale, elsewhere, other]).to_csv(tmp_path / FILE, index=False)
    measured = before.to_dict("records")
    monkeypatch.setattr("nsf.bench.full_order.run", lambda found: found.rows.extend(measured))
    page = bench(tmp_path, SMALL, lambda text: None)
    after = read(tmp_path / FILE)
    assert len(after) == 2 * len(before) + 1
    kept = after[after["device"] == "NVIDIA H200"]["median"].tolist()
    assert sorted(kept) == sorted(elsewhere["median"])  # to the last digit
    assert 1e9 not in after["median"].tolist()
    pictures = ["step-nvidia-h200.png", "kernels-nvidia-h200.png"]
    assert re.findall(r"\]\((.*?)\)", page.read_text())[:2] == pictures


def test_an_interrupted_benchmark_keeps_what_it_measured(speed, tmp_path, monkeypatch):
    """And the rows that were there before."""
    row = read(speed / FILE).iloc[0].to_dict()

    def run(found):
        found.rows.append(row | {"case": "first"})
        raise KeyboardInterrupt

    monkeypatch.setattr("nsf.bench.full_order.run", run)
    pd.DataFrame([row]).to_csv(tmp_path / FILE, index=False)
    with pytest.raises(KeyboardInterrupt):
        bench(tmp_path, SMALL, lambda text: None)
    assert set(read(tmp_path / FILE)["case"]) == {row["case"], "first"}
    assert "| first |" in (tmp_path / "index.md").read_text()


def test_a_benchmark_that_fails_at_once_leaves_no_file(tmp_path, monkeypatch):
    def run(found):
        raise ConfigError("no such thing")

    monkeypatch.setattr("nsf.bench.full_order.run", run)
    with pytest.raises(ConfigError):
        bench(tmp_path / "speed", SMALL, lambda text: None)
    assert not list((tmp_path / "speed").iterdir())


def test_bytes_of_a_pass_grow_with_particles_and_precision():
    sizes = {}
    for particles, precision in [(400, "fp32"), (400, "fp64"), (1600, "fp32")]:
        solver = collapse(particles, precision, "cpu")
        sizes[particles, precision] = np.array([size for _, size in pass_times(solver).values()])
    np.testing.assert_array_equal(sizes[400, "fp64"], 2 * sizes[400, "fp32"])
    # Of 4 bytes: x, v, C, τ, m and V of every particle and, there and back, the nodes.
    clear, p2g, grid, _ = sizes[400, "fp32"]
    assert p2g - grid == 4 * 26 * 400
    assert clear - grid // 2 == 4 * 3 * 400
    assert (sizes[1600, "fp32"] > sizes[400, "fp32"]).all()


def test_the_sand_falls_apart():
    solver = collapse(800, "fp64", "cpu")
    X = solver.constants.X
    solver.step(400)
    x = solver.state.numpy()["x"]
    assert x[:, 2].max() < X[:, 2].max()
    assert np.ptp(x[:, 0]) > np.ptp(X[:, 0])
    assert solver.constants.volume0.sum() == pytest.approx(100 / 160**3)


class Solver:
    """Writes down its calls."""

    def __init__(self, name, done):
        self.name, self.done, self.steps_taken = name, done, 3

    def restart(self):
        self.done.append(f"restart {self.name}")

    def step(self, n):
        self.steps_taken += n
        self.done.append((self.name, n))


def test_windows_and_whole_runs_take_turns():
    done: list = []
    solvers = {name: Solver(name, done) for name in "ab"}
    found = window_times(solvers, 23, 2, "cpu")
    assert [name for name, n in done if n == 10] == ["a", "b"] * 2
    assert [len(times) for times in found.values()] == [2, 2]
    done.clear()
    found = turns({name: WholeRun(solver, 5) for name, solver in solvers.items()}, 2, "cpu")
    assert done == 3 * ["restart a", ("a", 5), "restart b", ("b", 5)]
    assert [len(times) for times in found.values()] == [2, 2]


def test_a_solver_that_is_refused_says_why():
    def make():
        raise ConfigError("too thin for the grid")

    with pytest.raises(ConfigError, match="too thin"):
        build(make, "cpu")


def test_a_floor_is_bytes_over_the_bandwidth_of_a_copy():
    assert 0 < bandwidth("cpu") < np.inf
    from nsf.bench.full_order import run

    said: list[str] = []
    found = Measurements(Settings((300,), ("fp64",), "cpu", 1), said.append)
    run(found)
    passes = wide(found.frame[found.frame["part"] != ""])
    np.testing.assert_allclose(passes["floor [ms]"], passes["moved [MiB]"] * 2**20 / 1e6)
    assert "full_order_300 fp64" in said[-1]


@pytest.mark.parametrize(
    ("asked", "error", "message"),
    [
        ({"benches": "sorting"}, ConfigError, "benches=sorting is unknown; choose whole, full_order"),
        ({"particles": "10q"}, ConfigError, "particles=10q is no number of particles"),
        ({"particles": "9" * 400}, ConfigError, "is no number of particles up to a billion"),
        ({"particles": "0"}, ConfigError, "particles=0 is no number"),
        ({"trials": "0"}, ConfigError, "trials=0 must be"),
        ({"scenes": "cake,tea"}, ConfigError, "scenes=tea is unknown; choose bread, cake"),
        ({"precision": "fp16"}, ConfigError, "precision=fp16 is unknown"),
        ({"device": "tpu"}, DeviceError, "device=tpu"),
    ],
)
def test_bad_values(asked, error, message, tmp_path):
    with pytest.raises(error, match=re.escape(message)):
        bench(tmp_path, asked, lambda text: None)
    assert not list(tmp_path.iterdir())


def test_a_folder_that_takes_no_file_is_refused_before_anything_is_measured(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(StorageError, match="file/speed: Not a directory"):
        bench(tmp_path / "file/speed", SMALL, pytest.fail)


def test_the_command(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("NSF_REPORTS", str(tmp_path))
    words = ["benches=full_order", "particles=0.2k", "trials=1", "device=cpu", "precision=fp64"]
    with pytest.raises(SystemExit) as end:
        main(["bench", *words])
    assert not end.value.code
    out, err = capsys.readouterr()
    assert "full_order_200" in out
    assert f"open {tmp_path / 'speed' / 'index.md'}" in out
    assert "GB/s" in err
    with pytest.raises(SystemExit) as end:
        main(["bench", "size=3"])
    assert end.value.code == 2
    assert "nsf bench has no key 'size'" in capsys.readouterr().err


# -- scenes ---------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def reduced(chain, pipeline_at):
    """Rows of the tiny chain, as of a scene of the benchmark."""
    found, said = measurements("fp32", "fp64")
    few_cells = ("sampler=cells", "sampler.size=9", "sampler.cells=2", "sampler.states=4")
    measured_chain({"": pipeline_at(chain.root), "_cells": pipeline_at(chain.root, *few_cells)}, found)
    assert len([line for line in said if not line.startswith("warning")]) == 12
    return found.frame


@pytest.mark.slow
def test_both_solvers_of_a_scene_have_rows(reduced, chain):
    steps = of(reduced, "step")
    assert steps["case"].tolist() == 2 * [
        "full_order_sand", "reduced_sand", "reduced_sand_cells", "reduced_sand_1.5dt", "reduced_sand_2dt",
        "reduced_sand_3dt",
    ]  # fmt: skip
    own, cells = (steps[steps["case"] == f"reduced_sand{end}"] for end in ("", "_cells"))
    assert (cells["integration"].to_numpy() < own["integration"].to_numpy()).all()
    assert (cells["sample"] <= 9).all()
    evaluated = pd.read_csv(chain.pipeline.evaluation.path / "results.csv")["delta"][0]
    assert of(reduced, "δ", "reduced_sand")[1] == pytest.approx(evaluated, rel=1e-6)
    assert of(reduced, "δ", "reduced_sand_3dt")[1] != pytest.approx(evaluated, rel=1e-3)


@pytest.mark.slow
def test_stages_and_floors_of_both_solvers(reduced):
    stages = reduced[reduced["what"] == "stage"]
    of_case = stages.groupby(["case", "precision"], sort=False)["part"].apply(list)
    own = ["inference", "p2g", "g2p", "inversion"]
    assert of_case.tolist() == 2 * [["p2g", "grid", "g2p", "stress"], own, own]
    moved = reduced[(reduced["what"] == "moved") & (reduced["part"] == "inference")]
    real = np.where(moved["precision"] == "fp64", 8, 4)
    modes = 8 * (3 + 6 + 9)  # of a particle, in fp32
    N = moved["integration"].astype(int)
    np.testing.assert_allclose(moved["median"], N * (4 * modes + 24 * real) / 2**20)
    assert (reduced[reduced["what"] == "floor"]["median"] > 0).all()


@pytest.mark.slow
def test_networks_have_a_row(tiny, chain):
    mlp = ("field=mlp", "trainer.steps=20", "trainer.frames_per_batch=8", "trainer.particles_per_batch=4")
    base = [o for o in tiny if not o.startswith(("field.modes", "field.depth", "trainer.steps"))]
    own = Pipeline(config.load([*base, *mlp]), say=lambda line: None, root=chain.root)
    found, _ = measurements("fp32", trials=1)
    measured_networks(own, found)
    (row,) = of(found.frame, "step").to_dict("records")
    assert (row["case"], row["integration"]) == ("reduced_sand_mlp", 500)
    own.deploy()
    own.evaluate()
    evaluated = pd.read_csv(own.evaluation.path / "results.csv")["delta"][0]
    assert of(found.frame, "δ", "reduced_sand_mlp") == [pytest.approx(evaluated, rel=1e-3)]


def test_training_is_timed_from_its_files(chain):
    found, said = measurements(trials=1)
    measured_training(again(chain), found)
    (row,) = found.rows
    assert (row["case"], row["what"], row["particles"]) == ("training_sand", "training", 500)
    assert len([line for line in said if not line.startswith("warning")]) == 1


# -- sizes ----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def sizes(chain):
    """Rows of the tiny chain at other numbers of particles and samples."""
    found, _ = measurements("fp32", "fp64", trials=1)
    measured_sizes(again(chain), (300, 1200), (15, 40), found)
    return found.frame


@pytest.mark.slow
def test_both_solvers_have_rows_at_every_size(sizes):
    steps, deltas = of(sizes, "step"), of(sizes, "δ")
    assert sorted(steps["case"]) == sorted(
        2 * ["full_order_300", "reduced_300", "full_order_1k", "reduced_1k"]
        + 2 * ["full_order_500", "reduced_500_s15", "reduced_500_s40"]
    )
    assert deltas["case"].str.startswith("reduced").all()
    assert deltas["sample"].tolist() == [20] * 4 + [15] * 2 + [40] * 2
    # The fields of one training serve at every size, where the body is another only by its grid.
    assert (deltas["median"] < 0.01).all()
    times = sizes[sizes["what"] == "time"]
    assert times.groupby(["case", "precision"])["part"].apply(list).tolist() == [PASSES] * 6


def test_fields_carried_over_are_those_between_the_particles(chain):
    scene, manifold = at_size(chain.pipeline.scene, 1200), chain.pipeline.manifold()
    fine = carried_over(manifold, scene, "cpu")
    X, xhat, mu = fine.X, manifold.training_latents[7], manifold.training_parameters[7]
    here, there = fine.restrict(np.arange(1200)), manifold.restrict(X=X)
    # Modes are kept in fp32.
    torch.testing.assert_close(here.position(xhat), there.position(xhat), rtol=0, atol=1e-6)
    torch.testing.assert_close(here.stress(xhat, mu), there.stress(xhat, mu), rtol=1e-4, atol=1e-2)
    np.testing.assert_array_equal(X.numpy(), scene.particles().X)


def test_a_body_of_another_size_stands_alike_on_its_grid(chain):
    scene = chain.pipeline.scene
    (floor,) = scene.solids
    for particles in (300, 1200, 40_000):
        other = at_size(scene, particles)
        assert len(other.particles()) == particles
        assert other.dt / other.dx == pytest.approx(scene.dt / scene.dx)
        assert other.dt * other.steps == pytest.approx(scene.dt * scene.steps, rel=0.05)
        below = floor.point[2] / other.dx
        assert below % 1 == pytest.approx(floor.point[2] / scene.dx % 1)
        assert particles * other.dx**3 == pytest.approx(len(scene.particles()) * scene.dx**3, rel=0.35)


# -- batches --------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def batches(chain):
    """Rows of batches of the tiny chain."""
    found, said = measurements("fp32", "fp64")
    measured_batches(again(chain), (1, 3, 2), found)
    assert len([line for line in said if not line.startswith("warning")]) == 6
    return found.frame


@pytest.mark.slow
def test_batches_have_rows_by_their_size(batches, chain):
    steps = of(batches, "step")
    assert steps["case"].tolist() == 2 * ["reduced_batch1", "reduced_batch2", "reduced_batch3"]
    assert steps["batch"].tolist() == 2 * [1, 2, 3]
    # The first simulation of each is that of the evaluation.
    evaluated = pd.read_csv(chain.pipeline.evaluation.path / "results.csv").iloc[0]
    double = of(batches, "δ")[of(batches, "δ")["precision"] == "fp64"]
    np.testing.assert_allclose(double["median"], evaluated["delta"], rtol=1e-6)
    assert (double["integration"] == round(evaluated["integration"])).all()


def test_the_cases_of_a_batch(chain):
    assert cases_of(chain.pipeline, 1) == [angle(26.0)]
    many = cases_of(chain.pipeline, 64)
    assert many[:4] == cases_of(chain.pipeline, 4)
    assert len(set(many)) == 64
    assert angle(22.0) <= min(many) < angle(22.5) < angle(37.5) < max(many) <= angle(38.0)


def test_a_batch_that_would_not_fit_is_left_out(monkeypatch):
    monkeypatch.setattr("torch.cuda.mem_get_info", lambda device: (1000, 2000))
    held = {1: 100, 4: 190}  # 70 and 30 for each
    assert not _too_large(24, held, "cuda:0")
    assert _too_large(25, held, "cuda:0")
    assert not _too_large(25, held, "cpu")
    assert not _too_large(256, {1: 100}, "cuda:0")


@pytest.mark.slow
def test_a_report_of_batches(batches, tmp_path):
    page, pictures = reported(batches, tmp_path)
    assert pictures == ["batch-cpu.png"]
    assert page.count("| reduced_batch3 |") == 2
    panel = step_over_batch(batches).axes[0]
    assert [line.get_xdata().tolist() for line in panel.lines] == 4 * [[1, 2, 3]]
    cells = batches.assign(case=batches["case"] + "_cells")
    legend = step_over_batch(pd.concat([batches, cells])).legends[0]
    assert [text.get_text() for text in legend.get_texts()] == [
        f"500 particles{end}, {precision}" for end in ("", ", cells") for precision in ("fp32", "fp64")
    ]
