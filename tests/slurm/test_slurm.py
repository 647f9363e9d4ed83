"""Sweeps through a real Slurm: `make test-slurm`, on Debian after `apt install slurm-wlm munge`."""

import os
import shutil
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import pytest
from cluster import cluster, missing

from nsf.runs import Run

pytestmark = [
    pytest.mark.slurm,
    pytest.mark.skipif(bool(missing()), reason=f"not installed: {', '.join(missing())}"),
]
pytest.importorskip("submitit", reason="submitit is not installed; pip install 'nsf[sweep]'")


@pytest.fixture(scope="module")
def slurm():
    with cluster() as environment:
        yield environment


@dataclass
class Sweep:
    """`nsf train -m` of the tiny chain through Slurm, which goes on while a test looks at it."""

    root: Path
    environment: dict[str, str]
    process: subprocess.Popen

    def runs(self) -> dict[int, Run]:
        """The trained manifolds by r."""
        return {run.config["latent_dim"]: run for run in Run.find("train", root=self.root)}

    def wait_for(self, what):
        """What a function gives once it gives something."""
        began = time.monotonic()
        while not (found := what()):
            assert time.monotonic() - began < 240, (self.scontrol("show", "job"), self.runs())
            assert self.process.poll() is None, self.process.communicate()
            time.sleep(0.2)
        return found

    def scontrol(self, *arguments):
        done = subprocess.run(
            ["scontrol", *arguments], env=self.environment, capture_output=True, text=True, check=True
        )
        return done.stdout

    def job_of(self, latent_dim: int) -> str:
        """The Slurm job that trains with that r."""
        for log in self.root.glob("multirun/slurm/*/*/*_log.out"):
            if f"latent_dim={latent_dim} " in log.read_text():
                return log.parent.name
        return ""

    def end(self):
        """Exit code, what was printed, and the errors."""
        out, err = self.process.communicate(timeout=300)
        return self.process.returncode, out, err


@pytest.fixture
def sweep(slurm, chain, tiny, tmp_path):
    """(*overrides) → the sweep."""
    root = tmp_path / "runs"
    shutil.copytree(chain.root / "simulate", root / "simulate")
    environment = slurm | {"NSF_RUNS": str(root), "OMP_NUM_THREADS": "1", "PYTHONPATH": os.getcwd()}
    started = []

    def start(*overrides):
        # Long enough to be interrupted, and r before what the jobs have in common, so that a log tells it.
        tiny_but_long = [o for o in tiny if not o.startswith(("latent_dim", "trainer.steps"))]
        keys = {"partition": "short", "cpus_per_task": 1, "timeout_min": 10}
        launcher = ["hydra/launcher=slurm", *(f"hydra.launcher.{key}={value}" for key, value in keys.items())]
        process = subprocess.Popen(
            [sys.executable, "-m", "nsf.cli", "train", "-m", *launcher, *overrides, *tiny_but_long],
            env=environment, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        started.append(process)
        return Sweep(root, environment, process)

    yield start
    for process in started:
        process.kill()
    subprocess.run(["scancel", "--user", str(os.getuid())], env=environment, check=False)


def in_training(sweep, latent_dim):
    """Whether the first network has a checkpoint and the run goes on."""

    def begun():
        run = sweep.runs().get(latent_dim)
        return run and run.status == "running" and list(run.path.glob("deformation/last.ckpt"))

    return begun


def test_a_sweep_with_a_failure_and_a_requeued_job(sweep):
    going = sweep("latent_dim=9,3,4", "trainer.steps=6000", "hydra.launcher.array_parallelism=3")
    going.wait_for(in_training(going, 3))
    job = going.wait_for(lambda: going.job_of(3))
    going.scontrol("requeue", job)
    going.wait_for(lambda: going.runs()[3].status in ("killed", "interrupted"))
    code, out, err = going.end()
    assert code == 2, err
    assert "3 jobs go into Slurm's queue" in out
    assert [line for line in err.splitlines() if line.startswith("failed: ")] == [
        "failed: latent_dim=9: latent_dim=9 exceeds the 8 displacement modes; choose field.modes > 9 or "
        "latent_dim <= 8"
    ]
    runs = going.runs()
    assert runs[3].complete
    assert runs[4].complete
    assert runs[9].status == "failed"
    assert "Restarts=1" in going.scontrol("show", "job", job)
    # It went on from its checkpoint: each start logs into a version of its own.
    assert len(list((runs[3].path / "deformation/csv").iterdir())) == 2
    assert len(list((runs[4].path / "deformation/csv").iterdir())) == 1


def test_a_killed_job_takes_no_sibling_with_it(sweep):
    going = sweep("latent_dim=3,4", "trainer.steps=3000")
    going.wait_for(in_training(going, 3))
    job = going.wait_for(lambda: going.job_of(3))
    subprocess.run(["scancel", "--signal=KILL", job], env=going.environment, check=True)
    code, _, err = going.end()
    assert code == 2, err
    assert "failed: latent_dim=3: its process died" in err
    assert f"{job}_0_log.err" in err
    assert going.runs()[3].status in ("killed", "interrupted")
    assert going.runs()[4].complete


def test_a_queue_that_is_not_there(sweep):
    code, _, err = sweep("latent_dim=3,4", "trainer.steps=10", "hydra.launcher.partition=nowhere").end()
    assert code == 2, err
    assert "error: no job could be launched" in err
    assert "invalid partition" in err.lower()
    assert "Traceback" not in err
