"""`nsf <stage> -m`: every combination of comma-separated values."""

import json
import shutil

import pandas as pd
import pytest
from forked import PlainReport, SignalAt, run_nsf

from nsf.cli import main
from nsf.runs import Run


@pytest.mark.slow
def test_every_combination_of_the_issues_grammar(nsf, copied, tmp_path):
    """nsf run -m scene=sand field.beta=[24,48] latent_dim=4,6 sampler.size=50,150"""
    root = copied("simulate")
    overrides = ["field.beta=[3,4]", "latent_dim=3,4", "sampler.size=20,30", "evaluation.trials=1"]
    outcome = nsf("run", root, *overrides, faults=[PlainReport()], multirun=True)
    assert outcome.code == 0, outcome.err
    assert len(Run.find("simulate", root=root)) == 4  # one data set for all
    trained, evaluated = Run.find("train", root=root), Run.find("evaluate", root=root)
    assert sorted(run.config["latent_dim"] for run in trained) == [3, 4]
    assert all(run.config["field"]["beta"] == [3, 4] for run in trained)
    results = pd.concat([pd.read_csv(run.path / "results.csv") for run in evaluated])
    assert sorted(zip(results["r"], results["sample"], strict=True)) == [(3, 20), (3, 30), (4, 20), (4, 30)]
    assert outcome.out.count("train: inputs unchanged, reused") == 2
    report = pd.read_csv(tmp_path / "work/reports/sand_small/results.csv")
    assert len(report) == 4
    for overrides in ("latent_dim=3 sampler.size=20", "latent_dim=4 sampler.size=30"):
        assert all(part in outcome.out for part in overrides.split())


@pytest.mark.parametrize("values", ["9,3", pytest.param("3,9", marks=pytest.mark.slow)])
def test_a_failing_job_does_not_stop_its_siblings(nsf, copied, values):
    root = copied("simulate")
    outcome = nsf("train", root, f"latent_dim={values}", multirun=True)
    assert outcome.code != 0
    assert "latent_dim=9 exceeds the 8 displacement modes" in outcome.err
    assert "Traceback" not in outcome.err
    runs = {run.config["latent_dim"]: run for run in Run.find("train", root=root)}
    assert runs[3].complete
    assert runs[9].manifest["status"] == "failed"


def test_a_value_out_of_range_shows_before_the_first_job(nsf, copied):
    root = copied("simulate")
    outcome = nsf("train", root, "trainer.steps=150,0", multirun=True)
    assert outcome.code == 2
    assert "steps=0" in outcome.err
    assert not Run.find("train", root=root)


@pytest.mark.parametrize(
    ("override", "quoted"),
    [
        ("model=projected,baseline", "model=baseline"),
        ("latent_dim=[", "latent_dim=["),
        ("field._target_=os.system,os.remove", "os.system is refused"),
    ],
)
def test_bad_grammar_is_refused_as_in_a_single_run(override, quoted, tiny, capsys):
    with pytest.raises(SystemExit) as end:
        main(["train", "-m", *tiny, override])
    assert end.value.code == 2
    assert quoted in capsys.readouterr().err


def test_control_c_stops_all_jobs(nsf, copied):
    root = copied("simulate")
    moment = SignalAt("nsf.kinematics.training.lightning:FieldTraining._step", 100)
    outcome = nsf("train", root, "latent_dim=3,4", faults=[moment], multirun=True)
    assert outcome.code == 130
    assert [run.manifest["status"] for run in Run.find("train", root=root)] == ["interrupted"]


def test_points_of_several_paths(tmp_path):
    arguments = ["point", "-m", "material=hencky", "path=simple_shear,oedometer", "point.points=20"]
    outcome = run_nsf(arguments, tmp_path / "runs", tmp_path / "work")
    assert outcome.code == 0, outcome.err
    assert len(list((tmp_path / "work/reports/point").glob("*.csv"))) == 2


@pytest.mark.slow
def test_an_experiment_runs_its_jobs_and_reports_them(nsf, copied, tmp_path):
    """A part of experiments/table1.yaml, made tiny and of one scene and field."""
    root = copied("simulate")
    tiny = ["scene=sand", "field=basis", "evaluation.trials=1"]
    arguments = ["+experiment=table1/scenes", "scale=small", "model=projected", *tiny]
    outcome = nsf("run", root, *arguments, faults=[PlainReport()], multirun=True)
    assert outcome.code == 0, outcome.err
    (report,) = (tmp_path / "work/reports/table1").glob("scenes_*")
    rows = pd.read_csv(report / "results.csv")
    found = set(zip(rows["stress"], rows["field"], strict=True))
    assert found == {("field", "basis"), ("deformation", "basis")}
    assert "How far is the reduced run" in (report / "index.md").read_text()
    assert "deformation only (baseline) & " in (report / "results.tex").read_text()
    again = nsf("report", root, *arguments, faults=[PlainReport()])
    assert again.code == 0
    assert "2 jobs, 0 missing" in again.out


@pytest.mark.slow
def test_an_experiment_may_ask_for_more_points(nsf, copied, tmp_path):
    """experiments/super_resolution.yaml, made tiny and of one field."""
    root = copied("simulate", "train")
    tiny = ["field=basis", "evaluation.trials=1", "super_resolution.factor=2"]
    arguments = ["+experiment=super_resolution", "scale=small", *tiny]
    outcome = nsf("run", root, *arguments, faults=[PlainReport()])
    assert outcome.code == 0, outcome.err
    (run,) = Run.find("superresolve", root=root)
    (report,) = (tmp_path / "work/reports").glob("super_resolution_*")
    table, own = (pd.read_csv(f / "superresolution.csv") for f in (report, run.path))
    pd.testing.assert_frame_equal(table[list(own)], own)
    assert (list(table["body"]), list(table["run"])) == (["sand"], [run.id])
    told = json.loads((report / "sources.json").read_text())
    assert told["runs"][run.id]["files"]["superresolution.csv"]
    page = (report / "index.md").read_text()
    assert "## At many more points" in page
    assert run.id in page
    shutil.rmtree(run.path)
    without = nsf("report", root, *arguments, faults=[PlainReport()])
    assert without.code == 2
    assert "superresolve not run" in without.err
    assert "## At many more points" not in (report / "index.md").read_text()


def test_a_report_names_what_is_missing(nsf, copied, tmp_path):
    root = copied("simulate", "train", "deploy", "evaluate")
    keys = ["+experiment=table1/scenes", "scene=sand", "scale=small", "field=basis", "model=projected"]
    outcome = nsf("report", root, *keys, faults=[PlainReport()])
    assert outcome.code == 2
    assert "missing: scale=small" in outcome.err
    assert "stress=deformation affine=none" in outcome.err
    (page,) = (tmp_path / "work/reports").glob("table1/scenes_*/index.md")
    assert "Missing" in page.read_text()


def test_an_experiment_without_results_says_how_to_get_them(nsf, copied):
    outcome = nsf("report", copied("simulate"), "+experiment=large", "scale=small")
    assert outcome.code == 2
    assert "run `nsf run +experiment=large`" in outcome.err


@pytest.mark.slow
def test_training_trajectories_go_once_their_jobs_are_done(nsf, copied):
    root = copied("simulate")
    arguments = ["latent_dim=3,4", "data.keep=held_out", "evaluation.trials=0"]

    def kept():
        runs = Run.find("simulate", root=root)
        return sorted(
            r.config["parameters"]["friction_angle"]["value"]
            for r in runs
            if (r.path / "trajectory.h5").exists()
        )

    failed = nsf("run", root, "latent_dim=9,3", *arguments[1:], faults=[PlainReport()], multirun=True)
    assert failed.code != 0
    assert kept() == [22.0, 26.0, 30.0, 38.0]  # a job that failed may be repeated
    outcome = nsf("run", root, *arguments, faults=[PlainReport()], multirun=True)
    assert outcome.code == 0, outcome.err
    assert kept() == [26.0]
    again = nsf("run", root, *arguments, faults=[PlainReport()], multirun=True)
    assert again.code == 0, again.err
    assert "3 of 4 trajectories are gone, and nothing needs them" in again.out
    assert kept() == [26.0]
    other = nsf("run", root, "latent_dim=2", "evaluation.trials=0", faults=[PlainReport()])
    assert other.code == 0, other.err
    assert kept() == [22.0, 26.0, 30.0, 38.0]


@pytest.mark.slow
def test_trajectories_that_a_job_is_held_to_stay(nsf, copied):
    root = copied("simulate", "train")
    arguments = ["deploy.split=test,train", "data.keep=held_out", "evaluation.trials=0"]
    outcome = nsf("run", root, *arguments, faults=[PlainReport()], multirun=True)
    assert outcome.code == 0, outcome.err
    assert all(run.complete for run in Run.find("simulate", root=root))
