"""Which stage took longest."""

from nsf import progress


def test_the_slowest_stage_is_named(monkeypatch):
    now = iter([0.0, 2.0, 2.0, 5.0, 5.0, 6.5])
    monkeypatch.setattr(progress, "_SECONDS", {})
    monkeypatch.setattr(progress.time, "monotonic", lambda: next(now))
    assert progress.slowest_stage() == ""
    for stage in ("simulate", "train", "simulate"):
        with progress.timed(stage):
            pass
    assert progress.slowest_stage() == "6.5 s, of which simulate took 3.5 s"
