"""The whole chain on a tiny scene: files, reuse, what a change runs again."""

import contextlib
import json
import os
import shutil
import subprocess
import sys
from dataclasses import replace

import h5py
import numpy as np
import pandas as pd
import pytest
import torch
from angles import angle

from nsf.data import Trajectory
from nsf.deployment import Rollout, Trust
from nsf.dynamics import GaussNewton, NeighbourSearch, ParticleSets, ProjectionResult, Taylor
from nsf.errors import ConfigError, InstabilityError, MissingRunError, NSFError
from nsf.evaluation import superresolution
from nsf.kinematics.manifold import Manifold
from nsf.mpm import FullOrderMPM
from nsf.pipeline.stages import evaluation
from nsf.results.columns import EVALUATED
from nsf.results.overview.tables import Column
from nsf.results.sources import open_sources
from nsf.runs import Run
from nsf.runs.listing import entries

STAGES = ("simulate", "train", "deploy", "evaluate")


def stamps(root):
    return {p: p.stat().st_mtime_ns for p in root.rglob("*") if p.is_file()}


def said_by(pipeline_at, root, *overrides, stages=STAGES):
    said = []
    pipeline = pipeline_at(root, *overrides, say=said.append)
    for stage in stages:
        pipeline.run(stage)
    return pipeline, [line for line in said if not line.startswith("simulate: warning")]  # 2 particles a cell


# -- files ----------------------------------------------------------------------------------------------


def test_what_is_said(chain):
    said = [line for line in chain.said if "warning" not in line]
    assert [line.split(":")[0] for line in said] == ["simulate", "train", *["deploy"] * 3, "evaluate"]
    assert "4 trajectories in" in said[0]
    assert "field=basis, r=4" in said[1]
    assert said[2] == "deploy: steps by modal"
    assert said[3] == f"deploy: friction_angle=26°: unknown: {Trust.unknown}"
    assert "model=projected, |S|=20, 1 cases" in said[4]
    assert "mean δ" in said[5]


def test_trajectories(chain):
    for value in (22.0, 26.0, 30.0, 38.0):
        with Trajectory.open(chain.trajectory(value)) as trajectory:
            assert trajectory.parameters == {"friction_angle": value}
            assert (trajectory.frames, trajectory.particles) == (25, 500)
            np.testing.assert_allclose(trajectory.t, 0.005 * np.arange(25))
            np.testing.assert_allclose(trajectory.read("x", 0)[0], chain.scene.particles().X, atol=1e-7)


def test_the_stored_frames_are_the_solvers_own(chain):
    """Frames go through a ring of blocks and a writer's thread on their way."""
    solver = chain.scene.full_order({"friction_angle": 26.0}, device="cpu")
    with Trajectory.open(chain.trajectory(26.0)) as trajectory:
        for n in (0, 1, 12, 24):
            solver.step(n - solver.steps_taken)
            state = solver.state.numpy()
            for name in ("x", "v"):
                np.testing.assert_allclose(trajectory.read(name, n)[0], state[name], rtol=1e-6, atol=1e-7)
            np.testing.assert_allclose(
                trajectory.read("C", n)[0], state["C"].reshape(-1, 9), rtol=1e-5, atol=1e-5
            )
            tau = state["tau"][:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
            np.testing.assert_allclose(trajectory.read("tau", n)[0], tau, rtol=1e-5, atol=1e-4)


def test_results_have_the_columns_of_a_report(chain):
    results = pd.read_csv(chain.pipeline.evaluation.path / "results.csv")
    assert list(results) == list(EVALUATED)
    assert len(results) == 1
    assert set(results.columns[results.isna().any()]) == {"error_bound"}  # there is no validation run
    assert (results["flag"][0], results["beyond"][0]) == ("unknown", 0)
    row = results.iloc[0]
    assert (row["scene"], row["model"], row["field"], row["split"]) == ("sand", "projected", "basis", "test")
    assert (row["r"], row["sample"], row["value"], row["precision"]) == (4, 20, 26.0, "fp64")
    assert (row["stress"], row["affine"]) == ("field", "field")
    assert (row["teach_seconds"], row["fallback_share"]) == (0.0, 0.0)
    assert row["break_even_runs"] > 0  # ∞ where a reduced run saves nothing
    assert (row["particles"], row["case"], row["seed"]) == (500, "friction_angle=26°", 0)
    assert row["device"] == "cpu"
    assert 0 < row["delta"] < 0.02
    assert row["delta"] < row["displacement_error"]
    assert row["step_ms_p10"] <= row["step_ms"] <= row["step_ms_p90"]
    assert 0 < row["distance"] < row["distance_max"] < 0.02
    assert row["decode_ms"] > 0
    assert row["ready_seconds"] > 0
    assert row["displacement_static"] == 1.0
    assert 0 < row["displacement_interpolated"] < row["displacement_nearest"] < 1.0
    assert 0.01 < row["displacement_coarse"] < 0.6
    cost = json.loads((chain.pipeline.evaluation.path / "cost.json").read_text())
    assert row["step_ms_coarse"] == cost["coarse_2"]["step_ms"] > 0
    assert cost["full_order"]["steps"] % cost["coarse_2"]["steps"] == 0
    (told,) = json.loads((chain.pipeline.evaluation.path / "summary.json").read_text())["rivals"]
    assert told["case"] == "friction_angle=26°"
    assert told["coarse"]["2"]["displacement_error"] == pytest.approx(row["displacement_coarse"])
    assert 20 < row["integration"] <= 500


def test_files_of_an_evaluation(chain):
    """docs/design.md, "Evaluation's files"."""
    path = chain.pipeline.evaluation.path
    series = pd.read_csv(path / "series.csv")
    assert len(series) == 25
    assert {"case", "split", "frame", "t", "delta", "xhat_1", "xhat_4", "encoded_4"} <= set(series)
    frames = np.load(path / "frames.npz")
    assert frames["cases"].tolist() == ["friction_angle=26°"]
    assert frames["x_full"].shape == frames["x_reduced"].shape == (1, 3, 100, 3)
    assert (
        frames["stress_full"].shape == frames["stress_reduced"].shape == frames["role"].shape == (1, 3, 100)
    )
    assert ((frames["role"] == 2).sum(axis=2) == 20).all()  # S is among the particles of pictures
    assert set(np.unique(frames["role"])) == {0, 1, 2}  # S moves as particles about it do, not as all do
    cost = json.loads((path / "cost.json").read_text())
    assert set(cost["breakdown"]["reduced"]) == {"inference", "p2g", "g2p", "inversion"}
    assert cost["trials"] == 1
    summary = json.loads((path / "summary.json").read_text())
    assert summary["reconstruction_delta"] < chain.pipeline.evaluation.metric("delta")


def test_manifests(chain):
    p = chain.pipeline
    for run in (*(p.simulation(angle(v)) for v in (22, 26, 30, 38)), p.training, p.deployment, p.evaluation):
        assert run.manifest["status"] == "complete"
        assert run.complete
    assert p.training.manifest["parents"] == [p.simulation(angle(v)).id for v in (22, 30, 38)]
    assert p.deployment.manifest["parents"] == [p.training.id]
    assert p.evaluation.manifest["parents"] == [p.deployment.id, p.simulation(angle(26)).id]
    metrics = p.deployment.manifest["metrics"]
    assert (metrics["needed_outside"], metrics["engine"], metrics["engine_why"]) == (0, "modal", "")


def test_the_manifold_knows_its_data(tiny_manifold):
    assert sorted(set(tiny_manifold.training_parameters.flatten().tolist())) == [22.0, 30.0, 38.0]


# -- reuse ----------------------------------------------------------------------------------------------


def test_a_second_run_reuses_every_stage(chain, pipeline_at):
    before = stamps(chain.root)
    pipeline, said = said_by(pipeline_at, chain.root)
    runs = (pipeline.training, pipeline.deployment, pipeline.evaluation)
    assert said[0] == "simulate: 4 of 4 trajectories are there, reused"
    assert said[1:] == [f"{run.stage}: inputs unchanged, reused → {run.id}" for run in runs]
    assert stamps(chain.root) == before


def test_results_of_another_device_are_taken(chain, pipeline_at):
    elsewhere = pipeline_at(chain.root).on("cuda:0")
    assert elsewhere.evaluation.id != chain.pipeline.evaluation.id
    assert elsewhere.evaluated().id == chain.pipeline.evaluation.id
    here = pipeline_at(chain.root, "scene.design.validation=[34]")
    there = here.on("cuda:0")
    assert there.deployment.id != here.deployment.id
    assert there.on("cpu").deployment.id == here.deployment.id


def test_another_method_deploys_and_evaluates_again(copied, pipeline_at):
    root = copied(*STAGES)
    before = stamps(root)
    pipeline, said = said_by(pipeline_at, root, "stress=deformation", "affine=none")
    assert "4 of 4 trajectories are there, reused" in said[0]
    assert "train: inputs unchanged, reused" in said[1]
    assert "model=projected" in said[-2]
    assert said[-1].startswith("evaluate: mean δ")
    assert {p: t for p, t in stamps(root).items() if p in before} == before
    results = pd.read_csv(pipeline.evaluation.path / "results.csv")
    assert results["stress"].tolist() == ["deformation"]
    assert list(results) == list(EVALUATED)


def test_another_test_value_simulates_only_that_one(copied, pipeline_at):
    root = copied(*STAGES)
    before = stamps(root)
    pipeline, said = said_by(pipeline_at, root, "scene.design.test=[26,34]")
    assert said[0] == "simulate: 4 of 5 trajectories are there, reused"
    assert "simulate: 1 trajectories in" in said[1]
    assert "train: inputs unchanged, reused" in said[2]
    assert "2 cases" in said[-2]
    assert {p: t for p, t in stamps(root).items() if p in before} == before
    results = pd.read_csv(pipeline.evaluation.path / "results.csv")
    assert results["value"].tolist() == [26.0, 34.0]


def test_values_deployed_together_are_as_one_by_one(copied, pipeline_at, monkeypatch):
    root, keys = copied("simulate", "train"), ("scene.design.test=[26,34,36]", "evaluation.trials=1")
    said_by(pipeline_at, root, *keys, stages=("simulate",))
    found = {}
    for batch in (1, 2):
        shutil.rmtree(root / "deploy", ignore_errors=True)
        pipeline, said = said_by(pipeline_at, root, *keys, f"deploy.batch={batch}", stages=("deploy",))
        run = pipeline.deployment
        found[batch] = run.hash, [Rollout.open(run.path / f"rollout_{i}.h5") for i in range(3)]
        assert run.manifest["metrics"]["batch"] == batch
        assert ("3 cases, 2 together → " in said[-1]) == (batch == 2)
    (one_hash, ones), (other_hash, others) = found.values()
    assert one_hash == other_hash
    for one, other in zip(ones, others, strict=True):
        assert (one.case, one.stops, one.diverged) == (other.case, other.stops, other.diverged)
        assert (one.sample, one.integration_mean) == (other.sample, other.integration_mean)
        np.testing.assert_allclose(one.xhat, other.xhat, rtol=0, atol=1e-10)
    counted = []

    class Counted(evaluation.Progress):
        def __exit__(self, *exception):
            counted.append((self._done, self._total))
            super().__exit__(*exception)

    monkeypatch.setattr(evaluation, "Progress", Counted)
    assert pipeline.evaluate().complete
    assert counted
    assert all(done == total > 0 for done, total in counted)


def test_an_edited_step_is_deployed_anew_and_runs(copied, pipeline_at, monkeypatch):
    """What a reader changes in the reference takes effect in a run that was made before."""
    root = copied(*STAGES)
    solve = GaussNewton.solve

    def damped(self, at, target, xhat, weights=None):
        result = solve(self, at, target, xhat, weights)
        return replace(result, xhat=xhat + 0.9 * (result.xhat - xhat))

    before = pipeline_at(root).deployment
    monkeypatch.setattr(GaussNewton, "solve", damped)
    pipeline, said = said_by(pipeline_at, root, stages=("deploy",))
    assert pipeline.deployment != before
    assert "deploy: steps by reference, since nsf.dynamics." in said[-3]
    assert "nsf.dynamics.projection.GaussNewton.solve" in said[-3]
    one, other = (Rollout.open(run.path / "rollout_0.h5").xhat for run in (before, pipeline.deployment))
    assert np.abs(one - other).max() > 1e-3


def test_deploying_on_another_scene_than_the_one_trained_on(copied, pipeline_at):
    """Appendix "Generalization": the deployed scene and its truths differ, the training does not."""
    root = copied(*STAGES)
    before = stamps(root)
    change = "scene.gravity"
    plain = pipeline_at(root)
    pipeline, said = said_by(
        pipeline_at, root, f"deploy.changes={{{change}:[0,0,-6]}}", "evaluation.trials=0"
    )
    assert said[0] == "simulate: 3 of 4 trajectories are there, reused"
    assert "train: inputs unchanged, reused" in said[2]
    assert {p: t for p, t in stamps(root).items() if p in before} == before
    assert (
        pipeline.truth(angle(26.0)).hash
        != pipeline.simulation(angle(26.0)).hash
        == plain.truth(angle(26.0)).hash
    )
    assert pipeline.evaluation.manifest["parents"] == [pipeline.deployment.id, pipeline.truth(angle(26.0)).id]
    assert json.loads((pipeline.evaluation.path / "summary.json").read_text())["changes"] == {
        change: [0, 0, -6]
    }
    fallen = []
    for run in (plain.truth(angle(26.0)), pipeline.truth(angle(26.0))):
        with Trajectory.open(run.path / "trajectory.h5") as trajectory:
            fallen.append((trajectory.X - trajectory.read("x", 12)[0])[:, 2].mean())
    assert fallen[1] > 1.2 * fallen[0] > 0
    # The reduced run falls further too: its grid step has the other gravity.
    latents = [h5py.File(p.deployment.path / "rollout_0.h5")["xhat"][()] for p in (plain, pipeline)]
    manifold = Manifold.load(plain.training.path / "manifold.pt")
    z = [manifold.restrict().position(torch.tensor(xhat[12]))[:, 2].mean().item() for xhat in latents]
    assert z[1] < z[0]
    # The changed truth is what a plain run of that scene makes.
    assert pipeline_at(root, f"{change}=[0,0,-6]").simulation(angle(26.0)).complete


def test_extrapolation(copied, pipeline_at):
    """Appendix "Generalization": friction angles beyond those of training, which reach 38° here."""
    root = copied("simulate", "train")
    pipeline, said = said_by(pipeline_at, root, "scene.design.test=[44,55]", "evaluation.trials=0")
    assert "train: inputs unchanged, reused" in said[2]
    results = pd.read_csv(pipeline.evaluation.path / "results.csv")
    assert results["value"].tolist() == [44.0, 55.0]
    assert 0 < results["delta"][0] < results["delta"][1]
    assert results["flag"].tolist() == ["red", "red"]
    assert results["beyond"].tolist() == [1, 1]
    assert any("friction_angle=44 is outside of 22 … 38" in line for line in said)


def test_a_changed_training_value_is_another_simulation(chain, pipeline_at):
    pipeline = pipeline_at(chain.root, "deploy.split=train", "deploy.changes={material.E:1900}")
    assert pipeline.training.hash == chain.pipeline.training.hash
    assert pipeline.truth(angle(30.0)).hash != pipeline.simulation(angle(30.0)).hash
    assert len(pipeline.needed()) == 7  # three values twice, and the test value


REDEPLOYED = {"deployment", "evaluation"}
RETRAINED = {"training", *REDEPLOYED}
ALL_ANEW = {"simulation", *RETRAINED}
HASHES = {
    # overrides → stages that they make anew
    "scene.design.test=[26,34]": REDEPLOYED,
    "affine=none": REDEPLOYED,
    "sampler.size=30": REDEPLOYED,
    "fallback=full": REDEPLOYED,
    "integration=search": REDEPLOYED,
    "deploy.dt_multiplier=1.5": REDEPLOYED,
    "deploy.changes={material.E:1900}": REDEPLOYED,
    "evaluation.trials=3": {"evaluation"},
    "latent_dim=3": RETRAINED,
    "seed=1": RETRAINED,
    "scene.dt=0.004": ALL_ANEW,
    "material.E=1900": ALL_ANEW,
    "precision=fp32": ALL_ANEW,
    "model=projected deploy.changes={} super_resolution.factor=3 report.name=other scene.title=Other": set(),
    "tracking=tensorboard data.resident=true": set(),
}


@pytest.mark.parametrize("overrides", HASHES)
def test_what_a_change_makes_anew(chain, pipeline_at, overrides):
    changed = pipeline_at(chain.root, *overrides.split())

    def names(pipeline):
        stages = {k: getattr(pipeline, k).hash for k in ("training", "deployment", "evaluation")}
        return stages | {"simulation": pipeline.simulation(angle(30.0)).hash}

    before, after = names(chain.pipeline), names(changed)
    assert {k for k in before if before[k] != after[k]} == HASHES[overrides]


def test_a_value_is_one_run_however_it_is_written(chain, pipeline_at):
    written = pipeline_at(chain.root, "scene.design.train=[22.0,3e1,38]")
    assert written.training.hash == chain.pipeline.training.hash


# -- order and splits -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("stage", "command"),
    [
        ("train", "nsf simulate"),
        ("deploy", "nsf train"),
        ("evaluate", "nsf deploy"),
        ("superresolve", "nsf deploy"),
        ("report", "nsf run"),
    ],
)
def test_a_stage_before_its_time(pipeline_at, tmp_path, stage, command):
    with pytest.raises(MissingRunError, match=f"run `{command}"):
        pipeline_at(tmp_path).run(stage)
    assert not Run.find(stage, root=tmp_path)
    assert not [p for p in tmp_path.rglob("*") if p.is_file()]


@pytest.mark.parametrize("stage", ["evaluate", "superresolve"])
def test_a_lost_truth_leaves_no_failed_run(copied, pipeline_at, stage):
    root = copied("simulate", "train", "deploy")
    pipeline = pipeline_at(root)
    shutil.rmtree(pipeline.truth(angle(26.0)).path)
    with pytest.raises(MissingRunError, match="run `nsf simulate"):
        pipeline.run(stage)
    assert not Run.find(stage, root=root)


def test_training_values_can_be_deployed(copied, pipeline_at):
    root = copied("simulate", "train")
    pipeline, _ = said_by(pipeline_at, root, "deploy.split=train", "evaluation.trials=0")
    results = pd.read_csv(pipeline.evaluation.path / "results.csv")
    assert results["split"].tolist() == ["train"] * 3
    assert results["value"].tolist() == [22.0, 30.0, 38.0]


def test_what_a_lost_training_needs_is_made_again(copied, pipeline_at):
    root = copied("simulate", "train", "deploy", "evaluate")
    stages = ("train", "deploy", "evaluate")
    pipeline = pipeline_at(root)
    assert pipeline.spare(stages) == {
        run.id for run in (*pipeline.training_data, pipeline.truth(angle(26.0)))
    }
    shutil.rmtree(pipeline.training.path)
    assert pipeline.spare(stages) == {pipeline.truth(angle(26.0)).id}
    same, _ = said_by(pipeline_at, root, "deploy.split=train", "evaluation.trials=0")
    shutil.rmtree(same.training.path)
    assert not same.spare(stages)


@pytest.mark.parametrize("override", ["material.E=inf", "scene.dt=inf", "projector.tolerance=nan"])
def test_a_number_that_is_not_finite_is_refused_or_taken_as_before(pipeline_at, tmp_path, override):
    with contextlib.suppress(NSFError):  # and no other error
        pipeline_at(tmp_path, override)


@pytest.mark.slow
def test_a_run_without_timings_is_reported(copied, pipeline_at, tmp_path, monkeypatch):
    monkeypatch.setattr("nsf.results.pictures.sections", lambda *_: [])  # which tell nothing of timings
    root = copied("simulate", "train", "deploy")
    pipeline = pipeline_at(root, "evaluation.trials=0", f"report.folder={tmp_path}")
    pipeline.evaluate()
    results = pd.read_csv(pipeline.evaluation.path / "results.csv")
    assert 0 < results["delta"][0] < 0.03
    assert results[["step_ms_full", "total_ms", "memory_mib"]].isna().all(axis=None)
    folder = pipeline.report().parent
    assert (folder / "delta.png").exists()
    assert not {"speedup-memory.png", "runtime.png"} & {path.name for path in folder.iterdir()}
    assert "speedup, step" not in (folder / "index.md").read_text()


def test_a_split_without_values(pipeline_at, tmp_path):
    with pytest.raises(ConfigError, match=r"deploy\.split=validation has no cases"):
        pipeline_at(tmp_path, "deploy.split=validation").deploy()


def test_a_longer_step_is_deployed_and_evaluated(copied, pipeline_at):
    root = copied("simulate", "train")
    pipeline, _ = said_by(pipeline_at, root, "deploy.dt_multiplier=1.5", "evaluation.trials=0")
    with h5py.File(pipeline.deployment.path / "rollout_0.h5") as file:
        assert file["xhat"].shape == (17, 4)
    assert 0 < pd.read_csv(pipeline.evaluation.path / "results.csv")["delta"][0] < 0.03


def test_needed_particles_outside_the_superset_are_told(copied, pipeline_at, monkeypatch):
    complete = NeighbourSearch.superset

    def incomplete(self, frames, sample, margin):
        sets = complete(self, frames, sample, margin)
        return ParticleSets(sets.sample, sets.integration[: len(sets.sample)], sets.nodes)

    monkeypatch.setattr(NeighbourSearch, "superset", incomplete)
    root, said = copied("simulate", "train"), []
    pipeline = pipeline_at(root, say=said.append)
    pipeline.run("deploy")
    missing = pipeline.deployment.manifest["metrics"]["needed_outside"]
    assert missing > 100
    (warning,) = [line for line in said if "a step needed" in line]
    assert f"friction_angle=26°: a step needed {missing} particles or nodes outside" in warning
    assert "integration=search" in warning  # the remedy


# -- divergence -----------------------------------------------------------------------------------------


class Breaks:
    """A projector that is lost as soon as a latent has moved by 0.5."""

    iterations, tolerance = 1, 1e-6

    start = Taylor.start

    def solve(self, at, target, xhat, weights=None):
        result = Taylor().solve(at, target, xhat)
        lost = (at.position(xhat)[:, 2].mean() - self.first(at, xhat)) < -1e-4
        bad = torch.full_like(result.xhat, float("nan"))
        return ProjectionResult(torch.where(lost, bad, result.xhat), result.residuals, result.updates)

    def first(self, at, xhat):
        if not hasattr(at, "_height"):
            at._height = at.position(xhat)[:, 2].mean()
        return at._height


def test_a_diverged_rollout_is_infinite_and_never_nan(copied, pipeline_at):
    root, said = copied("simulate", "train"), []
    pipeline = pipeline_at(root, say=said.append)
    pipeline.projector = Breaks()
    pipeline.run("deploy")
    pipeline.run("evaluate")
    assert any("friction_angle=26° diverged at step" in line and "∞" in line for line in said)
    assert pipeline.deployment.manifest["metrics"]["diverged"] == [26.0]
    assert pipeline.evaluation.manifest["metrics"]["diverged"] == ["friction_angle=26°"]
    (listed,) = entries({"stage": "evaluate"}, root=root)
    assert Column("metric").text(listed) == "diverged"
    results = pd.read_csv(pipeline.evaluation.path / "results.csv")
    assert (results[["delta", "displacement_error", "stress_error"]] == np.inf).all().all()
    costs = [
        "step_ms",
        "total_ms",
        "decode_ms",
        "step_ms_p10",
        "step_ms_p90",
        "memory_mib",
        "break_even_runs",
    ]
    assert results[costs].isna().all().all()  # of a run that has left the grid, and is none by a recurrence
    assert not results.drop(columns=costs).isna().any().any()
    assert (results["error_bound"][0], results["flag"][0]) == (np.inf, "red")
    frames = np.load(pipeline.evaluation.path / "frames.npz")
    assert np.isfinite(frames["x_reduced"]).all()
    for name in ("cost.json", "summary.json"):
        json.loads((pipeline.evaluation.path / name).read_text(), parse_constant=pytest.fail)


def test_an_unstable_simulation_tells_its_cfl_number(pipeline_at, tmp_path, monkeypatch):
    def check(solver):
        if solver.steps_taken == 24:
            raise InstabilityError("particle 3 became non-finite")

    monkeypatch.setattr(FullOrderMPM, "check", check)
    pipeline = pipeline_at(tmp_path, "scene.design.train=[30,31]")
    with pytest.raises(InstabilityError, match=r"particle 3 became non-finite; elastic CFL .* at step 0"):
        pipeline.run("simulate")
    error = pipeline.simulation(angle(26.0)).manifest["error"]
    assert "elastic CFL c dt/dx" in error
    with pytest.raises(InstabilityError, match=r"fine full-order run: .*; raise super_resolution\.substeps"):
        superresolution._full_order_frames(pipeline.scene.full_order, [24])


# -- super-resolution -----------------------------------------------------------------------------------


def test_super_resolution_of_a_deployment(copied, pipeline_at):
    root, options = copied(*STAGES), ("super_resolution.factor=2", "super_resolution.frames=3")
    pipeline, said = said_by(pipeline_at, root, *options, stages=["superresolve"])
    run = pipeline.superresolution
    assert run.manifest["parents"] == [pipeline.deployment.id, pipeline.truth(angle(26.0)).id]
    run_line, line, *explained = said
    assert any("what no field can know" in told for told in explained)
    assert explained[-1].endswith("superresolution.png")
    assert run_line.startswith("superresolve: friction_angle=26°: 1,000 full-order particles in ")
    assert "1,000 points" in line
    assert "at the 500 particles" in line
    table = pd.read_csv(run.path / "superresolution.csv")
    assert list(table)[:5] == ["case", "factor", "points", "delta", "displacement_error"]
    assert table[["factor", "points"]].to_numpy().tolist() == [[2, 1000]]
    assert table.notna().all(axis=None)
    assert table["seconds"][0] > 0
    assert 0 < table["delta"][0] < 0.05
    assert (run.path / "superresolution.png").stat().st_size > 4_000
    _, again = said_by(pipeline_at, root, *options, stages=["superresolve"])
    assert again == [f"superresolve: inputs unchanged, reused → {run.id}"]


# -- trust ----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def far(chain, pipeline_at, tmp_path_factory):
    """A case far outside, evaluated with both answers to distrust: pipelines, and what was said."""
    root, said = tmp_path_factory.mktemp("far") / "runs", []
    for stage in ("simulate", "train"):
        shutil.copytree(chain.root / stage, root / stage)
    keys = ("scene.design.test=[8]", "evaluation.trials=1")
    answers = ("none", "full")
    found = {a: pipeline_at(root, *keys, f"fallback={a}", say=said.append) for a in answers}
    for pipeline in found.values():
        for stage in STAGES:
            pipeline.run(stage)
    return found, said


def evaluated(pipeline):
    path = pipeline.evaluation.path
    return [pd.read_csv(path / name) for name in ("results.csv", "series.csv")]


def test_a_run_far_from_training_says_so(far):
    pipeline, said = far[0]["none"], far[1]
    results, _ = evaluated(pipeline)
    why = "friction_angle=8 is outside of 22 … 38"
    assert results.loc[0, ["flag", "flag_reason", "fallback_share"]].tolist() == ["red", why, 0.0]
    assert any(f"friction_angle=8°: red: {why}" in line for line in said)
    assert pipeline.deployment.manifest["metrics"]["flags"] == {
        "green": 0,
        "amber": 0,
        "red": 1,
        "unknown": 0,
    }


def test_the_full_order_solver_takes_the_whole_run(far):
    (reported, handed), said = far[0].values(), far[1]
    assert handed.training.id == reported.training.id
    assert any("friction_angle=8° goes to full, since projected is red" in line for line in said)
    results, series = evaluated(handed)
    assert results.loc[0, ["delta", "fallback_share", "flag"]].tolist() == [0.0, 1.0, "green"]
    assert results["step_ms"].isna().all()  # no reduced run's
    assert series.loc[1:, "xhat_1"].isna().all()
    files = handed.deployment.file("continuation_0.h5"), handed.truth(angle(8.0)).file("trajectory.h5")
    with Trajectory.open(files[0]) as own, Trajectory.open(files[1]) as truth:
        np.testing.assert_array_equal(own.read("x"), truth.read("x"))


# -- the command ----------------------------------------------------------------------------------------


@pytest.mark.slow
def test_nsf_run_in_a_process_of_its_own(copied, tiny, tmp_path):
    """The real command once, report and pictures included, on runs that are there already."""
    root = copied(*STAGES)
    environment = os.environ | {"NSF_RUNS": str(root), "NSF_REPORTS": str(tmp_path / "reports")}
    done = subprocess.run(
        [sys.executable, "-m", "nsf.cli", "run", *tiny],
        cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=120,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "simulate: 4 of 4 trajectories are there, reused" in done.stdout
    for stage in ("train", "deploy", "evaluate"):
        assert f"{stage}: inputs unchanged, reused" in done.stdout
    assert "of the displacement" in done.stdout
    assert "Traceback" not in done.stderr
    assert "\r" not in done.stderr  # no progress bar where there is no terminal
    page = tmp_path / "reports/sand_small/index.html"
    assert str(page) in done.stdout
    assert page.stat().st_size > 1000
    columns = set(pd.read_csv(page.parent / "results.csv"))
    assert columns - {"report", "paper_delta"} <= {"run", "setting", *EVALUATED}
    assert not [p for p in tmp_path.iterdir() if p.name not in ("runs", "reports")]


def test_a_manifold_of_the_chain_loads_by_path_or_name(chain):
    assert torch.equal(Manifold.load(str(chain.checkpoint)).X, Manifold.load(chain.checkpoint).X)


def test_warnings_of_simulations_reach_the_report(chain):
    """The tiny column has few particles a cell, which its simulations said."""
    (source,) = open_sources([chain.pipeline.evaluation])
    (line,) = source.warnings
    assert "2.2 a cell" in line
