"""Trajectories that fit neither into memory nor onto the disk are refused before the first is made."""

import pytest

from nsf.errors import ConfigError, StorageError
from nsf.runs import Run


def test_the_disk_must_hold_all_trajectories(pipeline_at, tmp_path):
    pipeline = pipeline_at(tmp_path, "scene.steps=2000000000")
    with pytest.raises(StorageError, match=r"4 trajectories: it needs \d+\.\d MiB and the disk has"):
        pipeline.simulate()
    assert not Run.find("simulate", root=tmp_path)


def test_memory_must_hold_a_block_of_frames(pipeline_at, tmp_path, monkeypatch):
    pipeline = pipeline_at(tmp_path)
    monkeypatch.setattr("nsf.scenes.checks.host_memory", lambda: 2**29)
    with pytest.raises(ConfigError, match=r"500 particles on a grid .* would take 0\.\d GiB of memory"):
        pipeline.simulate()
    assert not Run.find("simulate", root=tmp_path)


def test_warnings_are_said_and_kept(pipeline_at, tmp_path):
    """By the run that makes a trajectory, in its manifest, and by every later one that uses it."""
    said = []
    keys = ("scene.bodies.column.particles=100", "scene.steps=2")
    runs = pipeline_at(tmp_path, *keys, say=said.append).simulate()
    (line,) = [line for line in said if "particles are" in line]
    assert line.startswith("simulate: warning: scene.bodies.column: 100 particles are 0.45 a cell")
    assert all(line.removeprefix("simulate: warning: ") in run.manifest["warnings"] for run in runs)
    said.clear()
    pipeline_at(tmp_path, *keys, say=said.append).simulate()
    assert line in said
