"""Which variants a report shows in pictures."""

from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from synthetic import Made, seal, write_run

from nsf.reporting import pictures
from nsf.reporting.sources import Study, open_sources
from nsf.reporting.tables import merge


def variant(delta, scene="sand", method="nsf", changes="", ended="", label="", run="evaluate/sand/1"):
    return SimpleNamespace(
        delta=delta, scene=scene, method=method, alike=(scene, changes), continued=lambda: ended,
        label=label, runs=[run],
    )  # fmt: skip


def test_a_run_that_the_full_order_solver_ends_is_shown_where_there_is_no_other():
    ended, lost = variant(1e-6, ended=" The full-order solver goes on."), variant(np.inf)
    assert pictures._best([ended, lost], by_method=True) == [lost]
    assert pictures._best([ended], by_method=True) == [ended]
    near, far = variant(0.01), variant(0.02)
    assert pictures._best([far, lost, near], by_method=True) == [near]


def test_each_change_of_the_deployed_scene_is_shown():
    plain, some, more = (variant(d, changes=c) for d, c in ((0.01, ""), (0.02, "8 %"), (0.1, "30 %")))
    assert pictures._best([plain, some, more], by_method=False) == [plain, some, more]


def test_the_baseline_is_of_the_same_scene_and_stands_beside_nsf_alone():
    own, other = (variant(0.3, scene, pictures.BASELINE) for scene in ("sand", "cake"))
    shown = variant(0.01)
    assert pictures._baseline(shown, [shown, other, own]) is own
    assert pictures._baseline(own, [shown, other, own]) is None
    assert pictures._baseline(shown, [shown, other]) is None


def test_variants_that_differ_in_seeds_alone_are_one_in_charts():
    labels = ("sand · |S| 43 · seed=0", "sand · |S| 47 · seed=1", "cake · |S| 50 · seed=0")
    known = [variant(0.0, label=label, run=str(i)) for i, label in enumerate(labels)]
    keys = {str(i): {"scene": label.partition(" ")[0], "seed": label[-1]} for i, label in enumerate(labels)}
    study = Study("?", "", {}, keys, [])
    assert pictures._over_seeds(known, study) == [("sand · 2 seeds", known[:2]), (labels[2], known[2:])]
    assert [name for name, _ in pictures._over_seeds(known, None)] == list(labels)


def test_what_is_varied_beside_the_seed_is_told_in_charts():
    labels = [f"nsf · |S| {40 + i} · noise={i // 2}, seed={i % 2}" for i in range(4)]
    known = [variant(0.0, label=label, run=str(i)) for i, label in enumerate(labels)]
    keys = {str(i): {"noise": f"{i // 2}", "seed": f"{i % 2}"} for i in range(4)}
    named = [name for name, _ in pictures._over_seeds(known, Study("?", "", {}, keys, []))]
    assert named == ["nsf · noise=0 · 2 seeds", "nsf · noise=1 · 2 seeds"]


def test_speedups_over_seeds_are_of_mean_times(tmp_path, monkeypatch):
    """A seed whose run is a hundred times as slow as the other's is not hidden by it."""
    found = [write_run(tmp_path / "runs", Made(seed=seed)) for seed in (0, 1)]
    for run, times in zip(found, (0.01, 1.0), strict=True):
        rows = pd.read_csv(run.path / "results.csv")
        rows["step_ms_full"], rows["step_ms_reduced"], rows["speedup_step"] = 1.0, times, 1 / times
        rows.to_csv(run.path / "results.csv", index=False)
        seal(run)
    keys = {run.id: {"scene": "sand", "seed": str(seed)} for seed, run in enumerate(found)}
    drawn = []
    monkeypatch.setattr(pictures.charts, "speedup_and_memory", lambda entries: drawn.extend(entries))
    monkeypatch.setattr(pictures, "save", lambda *given: [])
    merged = merge(open_sources(found), {run.id: f"seed={seed}" for seed, run in enumerate(found)})
    pictures.draw(merged, tmp_path, sweep=True, study=Study("?", "", {}, keys, []))
    (entry,) = drawn
    assert entry["speedup_step"] == pytest.approx(2 / 1.01)
