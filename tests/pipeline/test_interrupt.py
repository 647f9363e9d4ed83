"""Ctrl-C in every stage: exit code 130, nothing half-written, and the next run goes on."""

import os
import signal
import subprocess
import sys
import time

import pytest
import torch
from angles import angle
from forked import SignalAt

from nsf.data import Trajectory
from nsf.deployment import Rollout
from nsf.kinematics.manifold import Manifold
from nsf.runs import Run

STAGES = ("simulate", "train", "deploy", "evaluate")
#: Where the signal comes, and what is there already: in the middle of the stage's own work.
MOMENTS = {
    "simulate": SignalAt("nsf.mpm:FullOrderMPM.step", 40),
    "train": SignalAt("nsf.kinematics.training.lightning:FieldTraining._step", 330),
    "deploy": SignalAt("nsf.engines.modal.span:ModalSpan.project", 10),
    "evaluate": SignalAt("nsf.evaluation.cost:_stages"),
}


def nothing_half_written(root):
    """Whatever lies at a final name is whole, and no temporary file is left."""
    assert not [p for p in root.rglob("*") if ".partial" in str(p) or p.name.startswith("tmp")]
    for path in root.rglob("trajectory.h5"):
        Trajectory.open(path).close()
    for path in root.rglob("manifold.pt"):
        Manifold.load(path)
    for path in root.rglob("rollout_*.h5"):
        Rollout.open(path)
    for path in root.rglob("*.pt"):
        torch.load(path, weights_only=True)
    for stage in STAGES:
        for run in Run.find(stage, root=root):
            assert run.manifest["status"] in ("complete", "interrupted")
            assert run.complete or run.manifest["status"] == "interrupted"


def same_weights(path, other):
    one, two = (torch.load(p, weights_only=True) for p in (path, other))
    assert one["state"].keys() == two["state"].keys()
    return all(torch.equal(one["state"][k], two["state"][k]) for k in one["state"])


@pytest.mark.parametrize("stage", STAGES)
def test_control_c(nsf, copied, pipeline_at, stage):
    root = copied(*STAGES[: STAGES.index(stage)])
    outcome = nsf(stage, root, faults=[MOMENTS[stage]])
    assert outcome.code == 130, outcome.err
    assert "interrupted; the same command goes on from the last whole file" in outcome.err
    assert "Traceback" not in outcome.err
    nothing_half_written(root)
    stopped = [r for r in Run.find(stage, root=root) if r.manifest["status"] == "interrupted"]
    assert len(stopped) == 1
    whole = {
        p: p.stat().st_mtime_ns for r in Run.find(stage, root=root) if r.complete for p in r.path.iterdir()
    }
    assert bool(whole) == (stage == "simulate")  # the first trajectory was whole already

    said = []
    pipeline = pipeline_at(root, say=said.append)
    for name in STAGES[: STAGES.index(stage) + 1]:
        pipeline.run(name)
    assert {p: p.stat().st_mtime_ns for p in whole} == whole
    assert all(run.complete for run in Run.find(stage, root=root))
    if stage == "simulate":
        assert said[0].startswith("simulate: 1 of 4 trajectories are there, reused")
    else:
        assert said[0] == "simulate: 4 of 4 trajectories are there, reused"
    nothing_half_written(root)


@pytest.mark.slow
def test_control_c_from_outside(tiny, tmp_path, pipeline_at):
    """The real command, interrupted from another process as soon as it works."""
    root = tmp_path / "runs"
    arguments = [o for o in tiny if not o.startswith("scene.steps")]
    process = subprocess.Popen(
        [sys.executable, "-m", "nsf.cli", "simulate", *arguments, "scene.steps=1000"],
        cwd=tmp_path, env=os.environ | {"NSF_RUNS": str(root)}, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    began = time.monotonic()
    while not Run.find("simulate", root=root) and time.monotonic() - began < 60:
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    err = process.communicate(timeout=60)[1]
    assert process.returncode == 130, err
    assert "interrupted; the same command goes on" in err
    assert "Traceback" not in err
    assert len(Run.find("simulate", root=root)) < 4
    nothing_half_written(root)


def test_termination_is_as_control_c(nsf, copied):
    root = copied()
    moment = SignalAt("nsf.mpm:FullOrderMPM.step", 40, signal.SIGTERM)
    assert nsf("simulate", root, faults=[moment]).code == 130
    nothing_half_written(root)


@pytest.mark.parametrize("stage", ["simulate", "train"])
def test_a_killed_process_leaves_nothing_that_is_taken_for_whole(nsf, copied, pipeline_at, chain, stage):
    root = copied(*STAGES[: STAGES.index(stage)])
    moment = SignalAt(MOMENTS[stage].where, MOMENTS[stage].call, signal.SIGKILL)
    assert nsf(stage, root, faults=[moment]).code == -signal.SIGKILL
    pipeline = pipeline_at(root)
    pipeline.run("simulate")
    pipeline.run("train")
    for value in (22.0, 26.0, 30.0, 38.0):
        with Trajectory.open(pipeline.simulation(angle(value)).path / "trajectory.h5") as trajectory:
            assert trajectory.frames == 25
    assert same_weights(pipeline.training.path / "manifold.pt", chain.checkpoint)
