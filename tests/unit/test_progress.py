"""Which stage took longest."""

from nsf import progress


def test_the_slowest_stage_is_named(monkeypatch):
    now = iter([1.0, 3.0, 3.0, 4.0, 5.0, 6.0, 6.0, 7.5])
    monkeypatch.setattr(progress, "_SECONDS", {})
    monkeypatch.setattr(progress, "COMMAND", [0.0])
    monkeypatch.setattr(progress.time, "monotonic", lambda: next(now))
    assert progress.slowest_stage() == ""
    with progress.timed("simulate"):
        pass
    with progress.timed("train"), progress.timed(progress.START):
        pass
    with progress.timed("simulate"):
        pass
    assert progress.seconds_of("train") == 2.0
    assert progress.seconds_of(progress.START) == 2.0
    assert progress.slowest_stage() == "7.5 s, of which simulate took 3.5 s"


def test_a_process_that_is_no_command_counts_no_start(monkeypatch):
    monkeypatch.setattr(progress, "_SECONDS", {})
    monkeypatch.setattr(progress, "COMMAND", [])
    with progress.timed("train"):
        pass
    assert progress.seconds_of(progress.START) == 0.0
