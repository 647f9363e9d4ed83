"""`nsf bench`: rows, passes and the report; what a step takes is asserted nowhere."""

import dataclasses
import re

import numpy as np
import pandas as pd
import pytest
import torch
from angles import angle

from nsf import config
from nsf.bench import BENCHES, bench
from nsf.bench.batch import _too_large, cases_of
from nsf.bench.batch import measured as measured_batches
from nsf.bench.full_order import collapse, pass_times
from nsf.bench.full_order import run as full_order
from nsf.bench.measure import bandwidth, run_times, step_times
from nsf.bench.reduced import measured as measured_chain
from nsf.bench.reduced import measured_networks
from nsf.bench.report import (
    passes_beside_floor,
    step_over_batch,
    step_over_particles,
    step_over_sample,
    steps_by_scene,
    write_report,
)
from nsf.bench.rows import KernelRow, Result, Row, Settings, StageRow, columns, size_name
from nsf.bench.scaling import at_size, carried_over
from nsf.bench.scaling import measured as measured_sizes
from nsf.bench.training import measured as measured_training
from nsf.cli import main
from nsf.errors import ConfigError, DeviceError, StorageError
from nsf.pipeline import Pipeline
from nsf.usage import TOOLS

SMALL = {
    "benches": "full_order",
    "particles": "200,500",
    "trials": "2",
    "device": "cpu",
    "precision": "fp32",
}
PASSES = ["clear", "p2g", "grid", "g2p_stress"]


@pytest.fixture(scope="module")
def speed(tmp_path_factory):
    """The folder of a report of one benchmark."""
    folder = tmp_path_factory.mktemp("speed")
    bench(folder, SMALL, lambda text: None)
    return folder


def test_help_names_every_benchmark():
    assert f"benches={','.join(BENCHES)}]" in TOOLS["bench"][1]


def test_every_benchmark_gives_its_rows(speed):
    results, kernels = (pd.read_csv(speed / name) for name in ("results.csv", "kernels.csv"))
    assert list(results) == columns(Row)
    assert list(kernels) == columns(KernelRow)
    assert set(results["bench"]) == {"full_order"} < set(BENCHES)
    assert results["case"].tolist() == ["full_order_200", "full_order_500"]
    assert (results["ms_p10"] <= results["ms_median"]).all()
    assert (results["ms_median"] <= results["ms_p90"]).all()
    assert (results["peak_mib"] > 0).all()
    assert kernels.groupby(["bench", "case"], sort=False)["kernel"].apply(list).tolist() == [PASSES] * 2
    np.testing.assert_allclose(kernels["gb_per_s"], kernels["mib"] * 2**20 / kernels["ms"] / 1e6)


def test_the_page_shows_every_row_and_chart(speed):
    page = (speed / "index.md").read_text()
    assert page.count("| full_order_200 |") == 1 + 4
    for name in re.findall(r"\]\((.*?\.png)\)", page):
        assert (speed / name).is_file()
        assert (speed / name).with_suffix(".svg").is_file()
    assert re.findall(r"\]\((.*?)\)", page) == ["step-cpu.png", "kernels-cpu.png"]


def test_charts_of_a_step_and_its_passes_show_every_row(speed):
    results, kernels = (pd.read_csv(speed / f"{name}.csv") for name in ("results", "kernels"))
    line, floor = step_over_particles(results, kernels).axes[0].lines
    np.testing.assert_array_equal(line.get_ydata(), results["ms_median"])
    np.testing.assert_allclose(floor.get_ydata(), kernels.groupby("case", sort=False)["floor_ms"].sum())
    (panel,) = passes_beside_floor(kernels).axes
    last = kernels[kernels["case"] == "full_order_500"]
    assert [bar.get_width() for bar in panel.patches] == last["ms"].tolist()
    np.testing.assert_array_equal(panel.lines[0].get_xdata(), last["floor_ms"])


def test_other_rows_are_kept(speed, tmp_path):
    before = pd.read_csv(speed / "results.csv")
    before = pd.concat([before, before.iloc[:1].assign(bench="scaling", commit="old")], ignore_index=True)
    before.loc[0, ["device", "ms_median"]] = "NVIDIA H200", 12.5
    before.loc[1, ["ms_median", "commit"]] = 1e9, "old"
    before.to_csv(tmp_path / "results.csv", index=False)
    kernels = pd.read_csv(speed / "kernels.csv")
    of_gpu = kernels[kernels["case"] == before.loc[0, "case"]].assign(device="NVIDIA H200")
    pd.concat([kernels, of_gpu]).to_csv(tmp_path / "kernels.csv", index=False)
    page = bench(tmp_path, SMALL, lambda text: None)
    after = pd.read_csv(tmp_path / "results.csv")
    assert len(after) == 4
    assert after.loc[after["bench"] == "scaling", "commit"].tolist() == ["old"]
    assert after.loc[after["device"] == "NVIDIA H200", "ms_median"].tolist() == [12.5]
    assert 1e9 not in after["ms_median"].tolist()
    pictures = ["step-nvidia-h200.png", "kernels-nvidia-h200.png"]
    assert re.findall(r"\]\((.*?)\)", page.read_text())[:2] == pictures


def test_an_interrupted_benchmark_keeps_what_it_measured(speed, tmp_path, monkeypatch):
    """And the rows that were there before."""
    (row,) = pd.read_csv(speed / "results.csv").iloc[:1].to_dict("records")

    def run(settings, found, say):
        found.rows.append(Row(**row | {"case": "first"}))
        raise KeyboardInterrupt

    monkeypatch.setattr("nsf.bench.full_order.run", run)
    pd.DataFrame([row]).to_csv(tmp_path / "results.csv", index=False)
    with pytest.raises(KeyboardInterrupt):
        bench(tmp_path, SMALL, lambda text: None)
    assert set(pd.read_csv(tmp_path / "results.csv")["case"]) == {row["case"], "first"}
    assert "| first |" in (tmp_path / "index.md").read_text()


def test_a_benchmark_that_fails_at_once_leaves_no_file(tmp_path, monkeypatch):
    def run(settings, found, say):
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
    assert len(X) == 800
    solver.step(400)
    x = solver.state.numpy()["x"]
    assert x[:, 2].max() < X[:, 2].max()
    assert np.ptp(x[:, 0]) > np.ptp(X[:, 0])
    assert solver.constants.volume0.sum() == pytest.approx(100 / 160**3)


def test_sides_take_turns():
    class Solver:
        def __init__(self, name):
            self.name = name

        def step(self, n):
            taken.append(self.name)

    taken = []
    found = step_times({"a": Solver("a"), "b": Solver("b")}, 3, "cpu")
    assert taken[-6:] == ["a", "b"] * 3
    assert [len(times) for times in found.values()] == [3, 3]


def test_a_copy_has_a_bandwidth():
    assert np.isfinite(bandwidth("cpu"))
    assert bandwidth("cpu") > 0


def test_a_floor_is_bytes_over_that_bandwidth(monkeypatch):
    monkeypatch.setattr("nsf.bench.full_order.bandwidth", lambda device: 1e9)
    found, said = Result(), []
    full_order(Settings((300,), ("fp64",), "cpu", 1), found, said.append)
    assert [row.bench for row in found.rows] == ["full_order"]
    for row in found.kernels:
        assert row.floor_ms == pytest.approx(row.mib * 2**20 / 1e6)
    assert "full_order_300 fp64" in said[-1]
    assert dataclasses.asdict(found.rows[0])["sample"] is None


@pytest.mark.parametrize(
    ("count", "name"),
    [(300, "300"), (71_363, "71k"), (200_000, "200k"), (1_000_000, "1m"), (1_500_000, "1.5m")],
)
def test_sizes_by_name(count, name):
    assert size_name(count) == name


@pytest.mark.parametrize(
    ("asked", "error", "message"),
    [
        (
            {"benches": "sorting,foo"},
            ConfigError,
            "benches=sorting is unknown; choose from full_order, scaling",
        ),
        ({"particles": "10q"}, ConfigError, "particles=10q is no number of particles"),
        ({"particles": "9" * 400}, ConfigError, "is no number of particles up to a billion"),
        ({"particles": "0"}, ConfigError, "particles=0 is no number"),
        ({"trials": "0"}, ConfigError, "trials=0 must be"),
        ({"scenes": "cake,tea"}, ConfigError, "scenes=tea is not measured; choose from cake, metal"),
        ({"precision": "fp16"}, ConfigError, "precision='fp16' is unknown"),
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


@pytest.fixture(scope="module")
def found(chain, pipeline_at):
    """Rows of the tiny chain, as of a scene of the benchmark."""
    found, said = Result(), []
    settings = Settings(particles=(), precisions=("fp32", "fp64"), device="cpu", trials=2)
    few_cells = ("sampler=cells", "sampler.size=9", "sampler.cells=2", "sampler.states=4")
    chains = {"": pipeline_at(chain.root), "_cells": pipeline_at(chain.root, *few_cells)}
    measured_chain(chains, settings, found, said.append)
    assert len(said) == 12
    return found


@pytest.fixture(scope="module")
def reduced(found):
    """The rows."""
    return pd.DataFrame(found.rows, columns=columns(Row))


@pytest.mark.slow
def test_stages_of_both_solvers(found):
    stages = pd.DataFrame(found.stages, columns=columns(StageRow))
    of_case = stages.groupby(["case", "precision"], sort=False)["stage"].apply(list)
    reduced = ["inference", "p2g", "g2p", "inversion"]
    assert of_case.tolist() == 2 * [["p2g", "grid", "g2p", "stress"], reduced, reduced]
    assert (stages["ms"] > 0).all()


@pytest.mark.slow
def test_a_reduced_step_stands_beside_its_floor(found, reduced):
    kernels = pd.DataFrame(found.kernels, columns=columns(KernelRow))
    names = ["inference", "p2g", "7 empty launches"]
    assert kernels["kernel"].tolist() == 4 * names
    read = kernels[kernels["kernel"] == "inference"].set_index(["case", "precision"])["mib"]
    N = reduced.set_index(["case", "precision"])["integration"].reindex(read.index)
    real = np.where(read.index.get_level_values("precision") == "fp64", 8, 4)
    modes = 8 * (3 + 6 + 9)  # of a particle, in fp32
    np.testing.assert_allclose(read, N * (4 * modes + 24 * real) / 2**20)
    assert (kernels["floor_ms"] > 0).all()


def test_training_is_timed_from_its_files(chain):
    own = Pipeline(chain.pipeline.config, say=lambda line: None, root=chain.root)
    found, said = Result(), []
    measured_training(own, Settings((), (), "cpu", 2), found, said.append)
    (row,) = found.rows
    assert (row.case, row.particles, row.sample, row.delta) == ("training_sand", 500, None, None)
    assert row.ms_p10 < row.ms_median < row.ms_p90
    assert len(said) == 2


@pytest.mark.slow
def test_both_solvers_of_a_scene_have_rows(reduced, chain):
    assert reduced["case"].tolist() == 2 * [
        "full_order_sand", "reduced_sand", "reduced_sand_cells", "reduced_sand_1.5dt", "reduced_sand_2dt",
        "reduced_sand_3dt",
    ]  # fmt: skip
    own, cells = (reduced[reduced["case"] == f"reduced_sand{end}"] for end in ("", "_cells"))
    assert (cells["integration"].to_numpy() < own["integration"].to_numpy()).all()
    assert (cells["sample"] <= 9).all()
    full = reduced["case"] == "full_order_sand"
    for name in ("sample", "integration", "delta"):
        assert (reduced[name].isna() == full).all()
    assert (reduced["ms_median"] > 0).all()


@pytest.mark.slow
def test_delta_of_the_benchmark_is_that_of_the_evaluation(reduced, chain):
    evaluated = pd.read_csv(chain.pipeline.evaluation.path / "results.csv")["delta"][0]
    row = reduced[(reduced["case"] == "reduced_sand") & (reduced["precision"] == "fp64")].iloc[0]
    assert row["delta"] == pytest.approx(evaluated, rel=1e-6)
    longer = reduced[(reduced["case"] == "reduced_sand_3dt") & (reduced["precision"] == "fp64")].iloc[0]
    assert longer["delta"] != pytest.approx(evaluated, rel=1e-3)


@pytest.mark.slow
def test_networks_have_a_row(tiny, chain):
    mlp = ("field=mlp", "trainer.steps=20", "trainer.frames_per_batch=8", "trainer.particles_per_batch=4")
    base = [o for o in tiny if not o.startswith(("field.modes", "field.depth", "trainer.steps"))]
    found, said = Result(), []
    own = Pipeline(config.load([*base, *mlp]), say=lambda line: None, root=chain.root)
    measured_networks(own, Settings((), ("fp32",), "cpu", 1), found, said.append)
    (row,) = found.rows
    assert (row.case, row.integration) == ("reduced_sand_mlp", 500)
    own.deploy()
    own.evaluate()
    evaluated = pd.read_csv(own.evaluation.path / "results.csv")["delta"][0]
    assert row.delta == pytest.approx(evaluated, rel=1e-3)


@pytest.fixture(scope="module")
def sizes(chain):
    """Rows of the tiny chain at other numbers of particles and samples."""
    found, said = Result(), []
    settings = Settings(particles=(), precisions=("fp32", "fp64"), device="cpu", trials=1)
    own = Pipeline(chain.pipeline.config, say=lambda line: None, root=chain.root)
    measured_sizes(own, (300, 1200), (15, 40), settings, found, said.append)
    return found


def test_both_solvers_have_rows_at_every_size(sizes):
    rows = pd.DataFrame(sizes.rows, columns=columns(Row))
    assert rows["case"].tolist() == [
        *np.repeat(["full_order_300", "reduced_300", "full_order_1k", "reduced_1k"], 2),
        *np.repeat(["full_order_500", "reduced_500_s15", "reduced_500_s40"], 2),
    ]
    full = rows["case"].str.startswith("full_order")
    for name in ("sample", "integration", "delta"):
        assert (rows[name].isna() == full).all()
    assert rows["sample"].dropna().tolist() == [20] * 4 + [15] * 2 + [40] * 2
    assert rows["particles"].tolist() == [300] * 4 + [1200] * 4 + [500] * 6
    # The fields of one training serve at every size, where the body is another only by its grid.
    assert (rows["delta"].dropna() < 0.01).all()
    passes = pd.DataFrame(sizes.kernels, columns=columns(KernelRow))
    assert passes.groupby(["case", "precision"])["kernel"].apply(list).tolist() == [PASSES] * 6


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
    (floor,) = scene.colliders
    for particles in (300, 1200, 40_000):
        other = at_size(scene, particles)
        assert len(other.particles()) == particles
        assert other.dt / other.dx == pytest.approx(scene.dt / scene.dx)
        assert other.dt * other.steps == pytest.approx(scene.dt * scene.steps, rel=0.05)
        below = floor.point[2] / other.dx
        assert below % 1 == pytest.approx(floor.point[2] / scene.dx % 1)
        assert particles * other.dx**3 == pytest.approx(len(scene.particles()) * scene.dx**3, rel=0.35)


def test_a_report_of_sizes(sizes, tmp_path):
    rows = pd.DataFrame(sizes.rows, columns=columns(Row))
    rows.to_csv(tmp_path / "results.csv", index=False)
    pd.DataFrame(sizes.kernels, columns=columns(KernelRow)).to_csv(tmp_path / "kernels.csv", index=False)
    pd.DataFrame(columns=columns(StageRow)).to_csv(tmp_path / "stages.csv", index=False)
    page = write_report(tmp_path).read_text()
    assert re.findall(r"\]\((.*?)\)", page) == ["step-cpu.png", "sample-cpu.png", "kernels-cpu.png"]
    assert page.count("| reduced_500_s40 |") == 2
    of_sample = rows[rows["case"].str.contains("_s")]
    panel = step_over_sample(of_sample, rows[rows["case"] == "full_order_500"]).axes[0]
    assert [len(line.get_xdata()) for line in panel.lines] == 4 * [2]


@pytest.fixture(scope="module")
def batches(chain):
    """Rows of batches of the tiny chain."""
    found, said = Result(), []
    settings = Settings(particles=(), precisions=("fp32", "fp64"), device="cpu", trials=2)
    own = Pipeline(chain.pipeline.config, say=lambda line: None, root=chain.root)
    measured_batches(own, (1, 3, 2), settings, found, said.append)
    assert len(said) == 6
    return pd.DataFrame(found.rows, columns=columns(Row))


def test_batches_have_rows_by_their_size(batches, chain):
    assert batches["case"].tolist() == 2 * ["reduced_batch1", "reduced_batch2", "reduced_batch3"]
    assert batches["batch"].tolist() == [1, 2, 3, 1, 2, 3]
    assert (batches["ms_p10"] <= batches["ms_median"]).all()
    assert (batches["ms_median"] <= batches["ms_p90"]).all()
    # The first simulation of each is that of the evaluation.
    evaluated = pd.read_csv(chain.pipeline.evaluation.path / "results.csv").iloc[0]
    double = batches[batches["precision"] == "fp64"]
    np.testing.assert_allclose(double["delta"], evaluated["delta"], rtol=1e-6)
    assert (double["integration"] == round(evaluated["integration_mean"])).all()
    assert batches["particles"].unique().tolist() == [500]


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


def test_a_report_of_batches(batches, tmp_path):
    batches.to_csv(tmp_path / "results.csv", index=False)
    pd.DataFrame(columns=columns(KernelRow)).to_csv(tmp_path / "kernels.csv", index=False)
    pd.DataFrame(columns=columns(StageRow)).to_csv(tmp_path / "stages.csv", index=False)
    page = write_report(tmp_path).read_text()
    assert re.findall(r"\]\((.*?)\)", page) == ["batch-cpu.png"]
    assert page.count("| reduced_batch3 |") == 2
    assert "simulation-step" in page
    assert (tmp_path / "batch-cpu.png").is_file()
    panel = step_over_batch(batches).axes[0]
    assert panel.get_xscale() == panel.get_yscale() == "log"
    assert [line.get_xdata().tolist() for line in panel.lines] == 4 * [[1, 2, 3]]
    cells = batches.assign(case=batches["case"] + "_cells")
    legend = step_over_batch(pd.concat([batches, cells])).legends[0]
    assert [text.get_text() for text in legend.get_texts()] == [
        f"500 particles{end}, {precision}" for end in ("", ", cells") for precision in ("fp32", "fp64")
    ]


def test_whole_runs_take_turns():
    class Solver:
        total_steps = 5

        def __init__(self, name):
            self.name = name

        def restart(self):
            done.append(f"restart {self.name}")

        def step(self, n):
            done.append((self.name, n))

    done = []
    found = run_times({"a": Solver("a"), "b": Solver("b")}, 2, "cpu")
    assert done == 3 * ["restart a", ("a", 5), "restart b", ("b", 5)]
    assert [len(times) for times in found.values()] == [2, 2]


@pytest.mark.slow
def test_a_report_of_scenes(reduced, found, tmp_path):
    reduced.to_csv(tmp_path / "results.csv", index=False)
    kernels = pd.DataFrame(found.kernels, columns=columns(KernelRow))
    kernels.to_csv(tmp_path / "kernels.csv", index=False)
    stages = pd.DataFrame(found.stages, columns=columns(StageRow))
    stages.to_csv(tmp_path / "stages.csv", index=False)
    page = write_report(tmp_path)
    assert not (tmp_path / "stages-cpu.png").exists()  # the paper has no figures of sand
    stages.replace({"case": {"reduced_sand": "reduced_metal"}}).to_csv(tmp_path / "stages.csv", index=False)
    assert "(stages-cpu.png)" in write_report(tmp_path).read_text()
    assert "| reduced_sand_1.5dt |" in page.read_text()
    assert page.read_text().count("| 7 empty launches |") == 4
    assert (tmp_path / "reduced-cpu.png").is_file()
    points = steps_by_scene(reduced).axes[0].collections[0].get_offsets()
    np.testing.assert_array_equal(points[:, 0], reduced["ms_median"])
