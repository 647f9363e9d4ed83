"""The launchers of a sweep: what crosses from one process to another, and what is left of one that died."""

import os
import re
import signal
import sys
import time
from functools import partial
from types import SimpleNamespace

import pytest
from forked import SignalAt

from nsf import config as configuration
from nsf.errors import ConfigError, LaunchError, MissingExtraError
from nsf.pipeline.sweeps import jobs as module
from nsf.pipeline.sweeps.jobs import sweep
from nsf.runs import Run

pytest.importorskip("hydra_plugins.hydra_joblib_launcher", reason="hydra-joblib-launcher is not installed")
JOBLIB = ["hydra/launcher=joblib"]


@pytest.mark.slow
def test_a_failure_crosses_from_another_process(copied, tiny, monkeypatch):
    root = copied("simulate")
    monkeypatch.setenv("NSF_RUNS", str(root))
    (failure,) = sweep([[*tiny, "latent_dim=9,3"]], ["train"], JOBLIB)
    assert str(failure).startswith("latent_dim=9: latent_dim=9 exceeds the 8 displacement modes")
    runs = {run.config["latent_dim"]: run for run in Run.find("train", root=root)}
    assert runs[3].complete
    assert runs[9].manifest["status"] == "failed"
    assert "exceeds the 8 displacement modes" in runs[9].manifest["error"]


def dies_at(config, stages, seed, labels=(), group=""):
    if config.seed == seed:
        os.kill(os.getpid(), signal.SIGKILL)


@pytest.mark.slow
def test_a_dead_process_takes_no_sibling_with_it(tmp_path, monkeypatch):
    monkeypatch.setenv("NSF_RUNS", str(tmp_path))
    monkeypatch.setattr(module, "_job", partial(dies_at, seed=2))
    failed = sweep([["seed=1,2"]], ["train"], JOBLIB)
    assert [(failure.job, failure.error.split(" (")[0]) for failure in failed] == [
        (("seed=2",), "its process died")
    ]


def test_an_array_that_slurm_refuses_has_no_results_of_an_earlier_one(tmp_path):
    earlier = tmp_path / "71_0"
    earlier.mkdir()
    (earlier / "71_0_submitted.pkl").touch()

    class SlurmLauncher:
        def __init__(self):
            self.params = {"submitit_folder": str(tmp_path / "%j")}

        def launch(self, jobs, first):
            raise RuntimeError("sbatch: error: Batch job submission failed")

    with pytest.raises(LaunchError, match="submission failed"):
        module._launched(SlurmLauncher(), print, [["scene=sand"]], 1)


def says_its_gpu(config, stages, folder, labels=(), group=""):
    (folder / f"{config.seed}").write_text(os.environ.get("CUDA_VISIBLE_DEVICES", "all"))
    # The first job ends only once the other process has begun one, so that neither takes them all.
    began = time.monotonic()
    while len(list(folder.glob("[123]"))) < 2 and time.monotonic() - began < 60:
        time.sleep(0.02)


@pytest.mark.slow
@pytest.mark.parametrize(("device", "seen"), [("device=auto", {"4", "7"}), ("device=auto,cpu", {"all"})])
def test_jobs_side_by_side_see_one_gpu_each(tmp_path, monkeypatch, device, seen):
    monkeypatch.setenv("NSF_RUNS", str(tmp_path))
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    monkeypatch.setattr(module, "visible_gpus", lambda: ("4", "7"))
    monkeypatch.setattr(module, "_job", partial(says_its_gpu, folder=tmp_path))
    assert not sweep([["seed=1,2,3", device]], ["train"], JOBLIB)
    assert {(tmp_path / f"{seed}").read_text() for seed in (1, 2, 3)} == seen


def test_each_line_of_a_job_beside_others_names_it(tmp_path, monkeypatch, capsys, tiny):
    job = SimpleNamespace(
        job=SimpleNamespace(num=1), overrides=SimpleNamespace(task=["scene=sand", "seed=2"])
    )
    monkeypatch.setattr(module.HydraConfig, "get", lambda: job)
    monkeypatch.setattr(module, "work", lambda config, stages, say, group: say("train: begins"))
    config = configuration.load(tiny)
    assert module._job(config, ["train"], ["seed=1", "seed=2"]) is None
    assert capsys.readouterr().out.splitlines() == [
        "[seed=2] --- scene=sand seed=2",
        "[seed=2] train: begins",
    ]
    assert module._job(config, ["train"]) is None
    assert capsys.readouterr().out.splitlines() == ["--- scene=sand seed=2", "train: begins"]


def raises(config, stages, say, group):
    raise ValueError("not foreseen")


def test_an_error_that_is_no_ones_fault_is_told_too(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("NSF_RUNS", str(tmp_path))
    monkeypatch.setattr(module, "work", raises)
    (failure,) = sweep([["seed=1"]], ["train"])
    assert str(failure) == "the one job: ValueError: not foreseen"
    assert "Traceback" in capsys.readouterr().err


@pytest.mark.slow
def test_after_a_kill_only_the_job_in_flight_is_redone(nsf, copied):
    root = copied("simulate")
    # Each job takes 400 steps; the kill comes in the middle of the second one.
    moment = SignalAt("nsf.kinematics.training.lightning:FieldTraining._step", 700, signal.SIGKILL)
    killed = nsf("train", root, "seed=1,2,3", faults=[moment], multirun=True)
    assert killed.code == -signal.SIGKILL
    assert sorted(run.status for run in Run.find("train", root=root)) == ["complete", "killed"]
    (done,) = (run for run in Run.find("train", root=root) if run.complete)
    before = (done.path / "manifold.pt").stat().st_mtime_ns
    again = nsf("train", root, "seed=1,2,3", multirun=True)
    assert again.code == 0
    assert again.out.count("reused") == 1
    assert (done.path / "manifold.pt").stat().st_mtime_ns == before
    assert [run.status for run in Run.find("train", root=root)] == ["complete"] * 3


@pytest.mark.parametrize(("launcher", "plugin"), [("joblib", "joblib"), ("slurm", "submitit")])
def test_a_missing_extra_names_the_remedy(monkeypatch, launcher, plugin):
    monkeypatch.setitem(sys.modules, f"hydra_plugins.hydra_{plugin}_launcher", None)
    with pytest.raises(MissingExtraError, match=rf"{plugin}_launcher.*pip install 'nsf\[sweep\]'"):
        sweep([["seed=1"]], ["train"], [f"hydra/launcher={launcher}"])


def test_a_launcher_that_cannot_start(tmp_path, monkeypatch):
    monkeypatch.setenv("NSF_RUNS", str(tmp_path))
    with pytest.raises(LaunchError, match="no job could be launched: n_jobs == 0"):
        sweep([["seed=1"]], ["train"], [*JOBLIB, "hydra.launcher.n_jobs=0"])
    with pytest.raises(ConfigError, match=r"hydra\.launcher\.n_jobs=many"):
        sweep([["seed=1"]], ["train"], [*JOBLIB, "hydra.launcher.n_jobs=many"])


def test_a_launcher_is_for_sweeps(nsf, copied):
    outcome = nsf("train", copied("simulate"), *JOBLIB)
    assert outcome.code == 2
    assert "add -m" in outcome.err


def test_a_launcher_that_is_not_hydras():
    with pytest.raises(ConfigError, match=re.escape("hydra.launcher._target_=os.system is refused")):
        sweep([["seed=1"]], ["train"], ["hydra.launcher._target_=os.system"])
