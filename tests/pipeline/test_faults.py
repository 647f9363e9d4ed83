"""Files that are truncated, foreign, newer or malicious, and a disk without room."""

import json
import os
import pickle
import shutil
import subprocess

import h5py
import numpy as np
import pytest
import torch
from forked import FileLimit

from nsf.runs import Run

STAGES = ("simulate", "train", "deploy", "evaluate")


def replace(run: Run, name: str, spoil) -> None:
    """Change a file of a complete run; its manifest then says that size, as if it had always been so."""
    path = run.path / name
    spoil(path)
    manifest = json.loads((run.path / "manifest.json").read_text())
    for output in manifest["outputs"]:
        if output["path"] == name:
            output["bytes"] = path.stat().st_size
    (run.path / "manifest.json").write_text(json.dumps(manifest))


def truncate(path):
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def foreign_hdf5(path):
    path.unlink()
    with h5py.File(path, "w") as file:
        file["temperature"] = np.zeros(7)


def newer_hdf5(path):
    with h5py.File(path, "a") as file:
        file.attrs["schema_version"] = 99


def foreign_torch(path):
    torch.save({"weights": torch.zeros(3)}, path)


def text(path):
    path.write_text("not what you expect\n")


def newer_torch(path):
    content = torch.load(path, weights_only=True)
    torch.save(content | {"format_version": 99}, path)


class Bomb:
    def __init__(self, marker):
        self.marker = str(marker)

    def __reduce__(self):
        return os.system, (f"touch '{self.marker}'",)


@pytest.fixture
def refused(nsf, tmp_path):
    """(stage, root) → the one line that the stage is refused with."""

    def call(stage, root, *overrides, faults=()):
        outcome = nsf(stage, root, *overrides, faults=faults)
        assert outcome.code == 2, (outcome.out, outcome.err)
        errors = [line for line in outcome.err.splitlines() if line.startswith("error: ")]
        assert len(errors) == 1
        assert "Traceback" not in outcome.err
        return errors[0]

    return call


@pytest.mark.parametrize(
    ("spoil", "quoted"),
    [(truncate, "truncated"), (foreign_hdf5, "not written by nsf"), (text, "HDF5"), (newer_hdf5, "99")],
    ids=lambda value: getattr(value, "__name__", ""),
)
def test_a_bad_trajectory(refused, copied, pipeline_at, spoil, quoted):
    root = copied("simulate")
    run = pipeline_at(root).simulation(30.0)
    replace(run, "trajectory.h5", spoil)
    line = refused("train", root)
    assert str(run.path / "trajectory.h5") in line
    assert quoted.lower() in line.lower()
    assert "simulate" in line or "install" in line  # the remedy
    assert not [r for r in Run.find("train", root=root) if r.complete]


def test_a_trajectory_cut_short_is_simulated_again(copied, pipeline_at, refused, chain):
    root = copied("simulate")
    run = pipeline_at(root).simulation(30.0)
    whole = (run.path / "trajectory.h5").read_bytes()
    truncate(run.path / "trajectory.h5")
    assert str(run.path) in refused("train", root)
    said = []
    pipeline = pipeline_at(root, say=said.append)
    pipeline.run("simulate")
    assert said[0] == "simulate: 3 of 4 trajectories are there, reused"
    assert (run.path / "trajectory.h5").stat().st_size == len(whole)
    pipeline.run("train")


@pytest.mark.parametrize(
    ("spoil", "quoted"),
    [
        (truncate, "truncated"),
        (foreign_torch, "no manifold"),
        (text, "not a checkpoint"),
        (newer_torch, "99"),
    ],
    ids=lambda value: getattr(value, "__name__", ""),
)
def test_a_bad_checkpoint(refused, copied, pipeline_at, spoil, quoted):
    root = copied("simulate", "train")
    run = pipeline_at(root).training
    replace(run, "manifold.pt", spoil)
    line = refused("deploy", root)
    assert str(run.path / "manifold.pt") in line
    assert quoted in line
    assert "train" in line  # the remedy
    assert not Run.find("deploy", root=root)


def test_a_checkpoint_cut_short_is_trained_again(copied, pipeline_at, chain):
    root = copied("simulate", "train")
    pipeline = pipeline_at(root)
    truncate(pipeline.training.path / "manifold.pt")
    pipeline.run("train")
    one, other = (
        torch.load(p, weights_only=True) for p in (pipeline.training.path / "manifold.pt", chain.checkpoint)
    )
    assert all(torch.equal(one["state"][k], other["state"][k]) for k in one["state"])


def test_a_checkpoint_is_data_and_never_code(refused, copied, pipeline_at, tmp_path):
    root, marker = copied("simulate", "train"), tmp_path / "executed"
    for save in (torch.save, lambda value, path: path.write_bytes(pickle.dumps(value))):
        replace(pipeline_at(root).training, "manifold.pt", lambda path: save({"format": Bomb(marker)}, path))  # noqa: B023
        assert "manifold.pt" in refused("deploy", root)
        assert not marker.exists()


def test_a_bad_rollout(refused, copied, pipeline_at):
    root = copied("simulate", "train", "deploy")
    run = pipeline_at(root).deployment
    replace(run, "rollout_0.h5", truncate)
    line = refused("evaluate", root)
    assert str(run.path / "rollout_0.h5") in line
    assert "deploy" in line


def test_a_spoiled_manifest_is_an_incomplete_run(copied, pipeline_at):
    root = copied("simulate", "train")
    pipeline = pipeline_at(root)
    (pipeline.training.path / "manifest.json").write_text('{"status": "comp')
    assert not pipeline.training.complete
    pipeline.run("train")
    assert pipeline.training.complete


def half_written(root, stage, smallest=0):
    """Big results at a final name in a run that is not whole, and temporary files.

    The small files of an evaluate run are whole one by one.
    """
    incomplete = [run for run in Run.find(stage, root=root) if not run.complete]
    results = [p for run in incomplete for p in run.path.rglob("*") if p.suffix in (".h5", ".npz")]
    results = [p for p in results if p.stat().st_size >= smallest]
    return [*root.rglob(".partial-*"), *results]


@pytest.mark.parametrize(("stage", "limit"), [("simulate", 500_000), ("deploy", 4_500), ("evaluate", 5_000)])
def test_no_room_for_a_file(refused, copied, pipeline_at, stage, limit):
    """A file may not grow past a limit: a clear line, nothing half-written, and on it goes afterwards."""
    root = copied(*STAGES[: STAGES.index(stage)])
    line = refused(stage, root, faults=[FileLimit(limit)])
    assert "cannot write" in line
    assert "ulimit -f" in line
    assert not any(run.complete for run in Run.find(stage, root=root))
    assert not half_written(root, stage, smallest=limit)
    pipeline = pipeline_at(root)
    for name in STAGES[: STAGES.index(stage) + 1]:
        pipeline.run(name)
    assert all(run.complete for run in Run.find(stage, root=root))


@pytest.fixture
def disk_with(tmp_path, chain):
    """(stages, free) → a file system that holds these stages of the tiny chain and `free` bytes of room."""
    folder = tmp_path / "disk"
    folder.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=12m", "none", str(folder)]
    if shutil.which("mount") is None or subprocess.run(command, capture_output=True).returncode:
        pytest.skip("mounting a small disk is not permitted here")

    def fill(stages, free):
        for stage in stages:
            shutil.copytree(chain.root / stage, folder / stage)
        room = shutil.disk_usage(folder).free - free
        (folder / "filler").write_bytes(bytes(room))
        return folder

    yield fill
    subprocess.run(["umount", "-l", str(folder)], check=True)


@pytest.mark.parametrize(
    ("stage", "free"), [("simulate", 2_500_000), ("train", 150_000), ("deploy", 12_000), ("evaluate", 20_000)]
)
def test_a_full_disk(refused, disk_with, pipeline_at, stage, free):
    """Nothing is left half-made, and with some room the next run goes on; trajectories need room for all."""
    root = disk_with(STAGES[: STAGES.index(stage)], free)
    line = refused(stage, root)
    assert "cannot write" in line
    assert "free some space" in line
    assert not half_written(root, stage)
    assert not [run for run in Run.find(stage, root=root) if run.complete]
    assert ("4 trajectories: it needs 4.0 MiB and the disk has 2.4 MiB free" in line) == (stage == "simulate")
    (root / "filler").unlink()
    pipeline_at(root).run(stage)
    assert all(run.complete for run in Run.find(stage, root=root))


def test_a_folder_of_runs_that_is_a_file(refused, tmp_path):
    (tmp_path / "occupied").write_text("")
    line = refused("simulate", tmp_path / "occupied")
    assert "cannot write" in line
    assert str(tmp_path / "occupied") in line
