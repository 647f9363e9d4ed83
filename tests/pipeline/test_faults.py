"""Files that are cut short or changed, and a disk without room."""

import errno
import os
import shutil
import signal
import subprocess
import tempfile
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch
from angles import angle
from forked import FileLimit, GoneAt, Outcome, PlainReport
from test_interrupt import MOMENTS

from nsf.cli import main
from nsf.runs import Run

STAGES = ("simulate", "train", "deploy", "evaluate")


@pytest.fixture
def replace(seal):
    """(run, name, spoil) → a file of a complete run is another, which its manifest says it always was."""

    def change(run: Run, name: str, spoil) -> None:
        spoil(run.path / name)
        seal(run)

    return change


def truncate(path):
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


@pytest.fixture
def refused(nsf, tmp_path, tiny, monkeypatch, capsys):
    """(stage, root) → the one line that the stage is refused with; a fault takes a process of its own."""

    def here(stage, root):
        monkeypatch.setenv("NSF_RUNS", str(root))
        monkeypatch.setenv("NSF_REPORTS", str(tmp_path / "reports"))
        with pytest.raises(SystemExit) as end:
            main([stage, *tiny])
        return Outcome(end.value.code, *capsys.readouterr())

    def call(stage, root, faults=()):
        outcome = nsf(stage, root, faults=faults) if faults else here(stage, root)
        assert outcome.code == 2, (outcome.out, outcome.err)
        errors = [line for line in outcome.err.splitlines() if line.startswith("error: ")]
        assert len(errors) == 1
        assert "Traceback" not in outcome.err
        return errors[0]

    handler = signal.getsignal(signal.SIGTERM)
    yield call
    signal.signal(signal.SIGTERM, handler)


def test_a_trajectory_cut_short_is_simulated_again(copied, pipeline_at, refused):
    root = copied("simulate")
    run = pipeline_at(root).simulation(angle(30.0))
    whole = (run.path / "trajectory.h5").read_bytes()
    truncate(run.path / "trajectory.h5")
    assert str(run.path) in refused("train", root)
    said = []
    pipeline = pipeline_at(root, say=said.append)
    pipeline.run("simulate")
    assert said[0] == "simulate: 3 of 4 trajectories are there, reused"
    assert (run.path / "trajectory.h5").stat().st_size == len(whole)
    pipeline.run("train")


def test_a_checkpoint_cut_short_is_trained_again(copied, pipeline_at, chain):
    root = copied("simulate", "train")
    pipeline = pipeline_at(root)
    truncate(pipeline.training.path / "manifold.pt")
    pipeline.run("train")
    one, other = (
        torch.load(p, weights_only=True) for p in (pipeline.training.path / "manifold.pt", chain.checkpoint)
    )
    assert all(torch.equal(one["state"][k], other["state"][k]) for k in one["state"])


def test_a_spoiled_manifest_is_an_incomplete_run(copied, pipeline_at):
    root = copied("simulate", "train")
    pipeline = pipeline_at(root)
    (pipeline.training.path / "manifest.json").write_text('{"status": "comp')
    assert not pipeline.training.complete
    pipeline.run("train")
    assert pipeline.training.complete


def bit(path):
    """Change one bit in the middle, and not the size."""
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 4
    path.write_bytes(content)


def nan_weights(path):
    content = torch.load(path, weights_only=True)
    content["state"]["fields.stress.network.layers.0.weight"][0, 0] = float("nan")
    torch.save(content, path)


def nan_in(name, place):
    def change(path):
        with h5py.File(path, "a") as file:
            file[name][place] = np.nan

    return change


def another_file(path):
    with h5py.File(path, "a") as file:
        del file["frames/x"]
        file["frames/x"] = h5py.ExternalLink("/etc/passwd", "/")


#: The stage that reads a file, whose it is, and what it is called.
READ = [
    ("train", lambda p: p.simulation(angle(30.0)), "trajectory.h5"),
    ("deploy", lambda p: p.training, "manifold.pt"),
    ("evaluate", lambda p: p.deployment, "rollout_0.h5"),
    ("evaluate", lambda p: p.truth(angle(26.0)), "trajectory.h5"),
    ("evaluate", lambda p: p.training, "manifold.pt"),
]


@pytest.mark.parametrize(("stage", "run_of", "name"), READ)
def test_a_file_that_was_changed_after_its_run(refused, copied, pipeline_at, stage, run_of, name):
    root = copied(*STAGES[: STAGES.index(stage)])
    run = run_of(pipeline_at(root))
    bit(run.path / name)
    line = refused(stage, root)
    assert f"{run.path / name} has sha256" in line
    assert f"run `nsf {run.stage}" in line
    assert not [r for r in Run.find(stage, root=root) if r.complete]


@pytest.mark.parametrize(
    ("of", "change", "told"),
    [
        (READ[0], truncate, "is truncated"),
        (READ[1], truncate, "is truncated or no"),
        (READ[2], truncate, "is truncated or"),
        (READ[0], nan_in("frames/tau", (3, 7, 2)), "non-finite values of tau, as in frame 3"),
        (READ[0], another_file, "has a link in the place of frames/x"),
        (READ[1], nan_weights, "non-finite values of fields.stress.network.layers.0.weight"),
        (READ[2], nan_in("xhat", (7, 1)), "non-finite values of xhat"),
    ],
)
def test_what_no_run_leaves(refused, copied, pipeline_at, of, change, told, replace):
    """As if the run itself had left them."""
    stage, run_of, name = of
    root = copied(*STAGES[: STAGES.index(stage)])
    run = run_of(pipeline_at(root))
    replace(run, name, change)
    line = refused(stage, root)
    assert f"{run.path / name} " in line
    assert told in line
    assert run.stage in line
    assert not [r for r in Run.find(stage, root=root) if r.complete]


def half_written(root, stage, smallest=0):
    """Big results at a final name in a run that is not whole, and temporary files.

    The small files of an evaluate run are whole one by one.
    """
    incomplete = [run for run in Run.find(stage, root=root) if not run.complete]
    results = [p for run in incomplete for p in run.path.rglob("*") if p.suffix in (".h5", ".npz")]
    results = [p for p in results if p.stat().st_size >= smallest]
    return [*root.rglob(".partial-*"), *results]


@pytest.mark.parametrize(
    ("stage", "limit"), [("simulate", 500_000), ("train", 20_000), ("deploy", 4_500), ("evaluate", 5_000)]
)
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
def disk(tmp_path):
    """A small file system."""
    folder = tmp_path / "disk"
    folder.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=12m", "none", str(folder)]
    if shutil.which("mount") is None or subprocess.run(command, capture_output=True).returncode:
        pytest.skip("mounting a small disk is not permitted here")
    yield folder
    subprocess.run(["umount", "-l", str(folder)], check=True)


@pytest.fixture
def disk_with(disk, chain):
    """(stages, free) → a file system that holds these stages of the tiny chain and `free` bytes of room."""
    folder = disk

    def fill(stages, free):
        for stage in stages:
            shutil.copytree(chain.root / stage, folder / stage)
        room = shutil.disk_usage(folder).free - free
        (folder / "filler").write_bytes(bytes(room))
        return folder

    return fill


@pytest.mark.parametrize(("stage", "free"), [("simulate", 2_500_000), ("train", 150_000)])
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


@dataclass(frozen=True)
class TemporaryFilesIn:
    """A folder in place of /tmp."""

    folder: Path

    def __call__(self):
        tempfile.tempdir = str(self.folder)


def test_no_room_for_temporary_files(nsf, copied, disk, pipeline_at):
    """A training needs the disk of its run alone."""
    (disk / "filler").write_bytes(bytes(shutil.disk_usage(disk).free))
    root = copied("simulate")
    outcome = nsf("train", root, faults=[TemporaryFilesIn(disk)])
    assert outcome.code == 0, outcome.err
    assert pipeline_at(root).training.complete


@dataclass(frozen=True)
class NoRoomForLog:
    """The disk is full when a log is added to for the n-th time."""

    call: int

    def __call__(self):
        from pytorch_lightning.loggers import CSVLogger

        save, calls = CSVLogger.save, []

        def full(logger):
            calls.append(None)
            if len(calls) == self.call:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            save(logger)

        CSVLogger.save = full


def test_no_room_for_a_log(refused, copied, pipeline_at):
    root = copied("simulate")
    line = refused("train", root, faults=[NoRoomForLog(3)])
    assert "cannot write" in line
    assert "free some space" in line
    assert str(pipeline_at(root).training.path) in line


@pytest.mark.parametrize(
    ("stage", "moved"),
    [("simulate", True), ("train", False), ("train", True), ("deploy", False), ("evaluate", False)],
)
def test_a_folder_of_runs_that_goes_while_it_is_written(refused, copied, tmp_path, stage, moved):
    root, to = copied(*STAGES[: STAGES.index(stage)]), tmp_path / "elsewhere"
    where, call = MOMENTS[stage].where, MOMENTS[stage].call
    if stage == "simulate":  # a thread of its own writes a trajectory, and has begun by its second frame
        where, call = "nsf.data.trajectory:TrajectoryWriter.append", 2
    moment = GoneAt(where, call, root, to if moved else None)
    line = refused(stage, root, faults=[moment])
    assert str(root / stage) in line
    assert "was deleted or moved" in line
    assert "run the same command again" in line
    # Another trajectory may have been begun in a folder of its own, and is whole.
    assert not any(run.complete for run in Run.find(stage, root=root) if str(run.path) in line)
    assert not list(root.rglob(".partial-*"))
    assert to.is_dir() == moved


def test_a_folder_of_reports_that_goes_while_it_is_written(refused, copied, tmp_path):
    root = copied(*STAGES)
    reports = tmp_path / "work" / "reports"
    faults = [PlainReport(), GoneAt("nsf.results.folder:_take_place", 1, reports)]
    line = refused("report", root, faults=faults)
    assert str(reports) in line
    assert "was not written" in line
