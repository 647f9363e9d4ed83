"""The times that a store of runs holds of its work."""

from types import SimpleNamespace

import pytest

from nsf.pipeline import durations
from nsf.pipeline.durations import Work, measured, times
from nsf.runs import Run


@pytest.fixture
def run(tmp_path, monkeypatch):
    """A run of training that is due, and takes a second by the rates."""
    run = Run.open("train", "sand", {"latent_dim": 4}, root=tmp_path)
    monkeypatch.setattr(durations, "due", lambda pipeline, stage: {run: 1.0})
    monkeypatch.setattr(durations, "work_of", lambda *_: Work("train", "sand", "MlpField", "cpu", 1.0))
    return run


def stages(run, clear=False):
    """Stages with a time after a training."""
    with measured(SimpleNamespace(training=run), "train") as works:
        if clear:
            works.clear()
    return [work.stage for work, _ in times(run.root)]


def test_a_whole_training_has_a_time(run):
    with run.claimed():
        assert stages(run) == ["train"]


def test_work_of_which_others_did_a_part_has_none(run):
    assert stages(run, clear=True) == []


def test_a_resumed_training_has_none(run):
    run.path.mkdir(parents=True)
    (run.path / "manifest.json").touch()
    assert stages(run) == []


def test_an_estimate_that_fails_hides_no_error_of_the_stage(run, monkeypatch):
    monkeypatch.setattr(durations, "work_of", lambda *_: 1 / 0)
    assert stages(run) == []
    with pytest.raises(KeyError), measured(SimpleNamespace(training=run), "train"):
        raise KeyError


def test_a_system_without_a_load_is_not_crowded(monkeypatch):
    def refused():
        raise OSError

    monkeypatch.setattr(durations.os, "getloadavg", refused)
    assert durations.crowding() == 1.0
