"""Runs listed, filtered, sorted and compared, from manifests and configurations alone."""

import os
import subprocess
import sys

import pytest
from rich.console import Console

from nsf.cli import main
from nsf.errors import ConfigError
from nsf.results.overview.tables import difference_table
from nsf.runs import Run
from nsf.runs.listing import entries, listed, why_none


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    """Two data sets, three manifolds of the first, one of which failed, and two evaluations."""
    root = tmp_path_factory.mktemp("runs")
    data = [
        made(root, "simulate", {"parameters": {"mu": {"key": "material.mu", "value": v}}}, seconds=v)
        for v in (1.0, 2.0)
    ]
    trained = [made(root, "train", {"latent_dim": r}, data, deformation_loss=0.1 / r) for r in (4, 6)]
    with pytest.raises(ValueError, match="lost"), failing(root, data).record():
        raise ValueError("lost")
    for run, delta in zip(trained, (0.02, 0.001), strict=True):
        made(
            root,
            "evaluate",
            {"evaluation": {"trials": 2}},
            [run, data[0]],
            delta=delta,
            displacement_error=delta,
        )
    made(root, "simulate", {"parameters": {"E": {"key": "material.E", "value": 3.0}}}, scene="jelly")
    return root


def failing(root, data):
    return Run.open("train", "sand", {"latent_dim": 8}, data, root=root)


def made(root, stage, config, parents=(), scene="sand", **metrics):
    run = Run.open(stage, scene, config, parents, root=root)
    with run.record(device="cpu", seed=0) as record:
        record.metrics.update(metrics)
    return run


def shown(table):
    console = Console(width=160, color_system=None)
    with console.capture() as capture:
        console.print(table)
    return capture.get()


def test_all_newest_first(root):
    found = entries(root=root)
    assert [entry.run for entry in found] == Run.find(root=root)
    assert len(found) == 8


@pytest.mark.parametrize(
    ("filters", "count"),
    [
        ({"stage": "evaluate"}, 2),
        ({"stage": "evaluate", "latent_dim": "6"}, 1),  # a key of a run that it goes back to
        ({"stage": "train", "latent_dim": "4,8"}, 2),
        ({"status": "failed"}, 1),
        ({"scene": "j*"}, 1),
        ({"parameters.E.value": "3"}, 1),
        ({"parameters.mu.value": "2", "stage": "train"}, 3),  # of one of the data that it was made from
        ({"stage": "deploy"}, 0),
        ({"metric": "–", "stage": "evaluate,train"}, 1),  # as tables show a value that a run lacks
    ],
)
def test_filters(root, filters, count):
    assert len(entries(filters, root=root)) == count


def test_sorted_by_a_field_a_metric_and_a_key(root):
    assert [e.values["delta"] for e in entries({"stage": "evaluate"}, "delta", root)] == [0.001, 0.02]
    assert [e.values["metric"] for e in entries({"stage": "evaluate"}, "-metric", root)] == [0.02, 0.001]
    latent = [e.settings["latent_dim"] for e in entries({"stage": "train"}, "-latent_dim", root)]
    assert latent == [8, 6, 4]
    assert [e.values.get("delta") for e in entries(sort="delta", root=root)][:3] == [0.001, 0.02, None]


def test_an_unknown_key_names_the_nearest(root):
    with pytest.raises(ConfigError, match="'latent_dimm'; did you mean latent_dim"):
        entries({"latent_dimm": "4"}, root=root)
    with pytest.raises(ConfigError, match="'secnds'; did you mean seconds"):
        entries(sort="secnds", root=root)


def test_no_runs_at_all(tmp_path):
    assert entries(root=tmp_path) == []


@pytest.mark.parametrize(
    ("words", "code", "quoted"),
    [
        (["stage=foo"], 2, "no run can have stage=foo; choose simulate, train"),
        (["status=complete,done"], 2, "status=done; choose running, complete"),
        (["model=recurence"], 2, "no run can have model=recurence; choose auto"),
        (["stage=deploy"], 0, "none of 8 runs has stage=deploy; they have"),
        (["latent_dim=7"], 0, "none of 8 runs has latent_dim=7; they have"),
        (["stage=evaluate", "latent_dim=8"], 0, "none of 8 runs has all of stage=evaluate latent_dim=8"),
        (["latent_dim=7", "--csv"], 0, "none of 8 runs has latent_dim=7"),
        (["prune", "stage=foo", "yes=true"], 2, "no run can have stage=foo"),
    ],
)
def test_a_filter_that_no_run_passes(root, monkeypatch, capsys, words, code, quoted):
    monkeypatch.setenv("NSF_RUNS", str(root))
    with pytest.raises(SystemExit) as ended:
        main(["runs", *words])
    assert ended.value.code == code
    printed = capsys.readouterr()
    assert quoted in printed.err
    assert not printed.out or "--csv" in words


def test_runs_without_an_option(tmp_path):
    made(tmp_path, "deploy", {"model": {"name": "recurrence"}})
    without = made(tmp_path, "train", {})
    assert [entry.run for entry in entries({"model": "–"}, root=tmp_path)] == [without]
    assert len(entries({"model": "–,recurrence"}, root=tmp_path)) == 2
    assert why_none({"scene": "–"}, listed(tmp_path)) == "none of 2 runs has scene=–; they have sand"


def test_a_field_that_no_run_has_ends_the_sentence(tmp_path):
    made(tmp_path, "simulate", {})
    assert why_none({"metric": "0.5"}, listed(tmp_path)) == "none of 1 runs has metric=0.5"


def test_why_none_reads_no_run_again(root, monkeypatch, capsys):
    monkeypatch.setenv("NSF_RUNS", str(root))
    looks = []
    find = Run.find
    monkeypatch.setattr(Run, "find", lambda *a, **k: looks.append(a) or find(*a, **k))
    with pytest.raises(SystemExit):
        main(["runs", "latent_dim=7"])
    assert len(looks) == 1
    assert "none of 8 runs" in capsys.readouterr().err


def test_no_runs_yet(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("NSF_RUNS", str(tmp_path))
    with pytest.raises(SystemExit) as ended:
        main(["runs"])
    assert (ended.value.code, capsys.readouterr().out) == (0, "")


def test_what_differs(root):
    two, one = entries({"stage": "evaluate"}, root=root)
    text = shown(difference_table(one.run, two.run))
    rows = [line.split() for line in text.splitlines()]
    assert ["configuration", "latent_dim", "4", "6", "+50", "%"] in rows
    assert ["origin", "the", "same"] in rows
    assert any(row[-4:] == ["2", "0.100", "-95", "%"] and "delta" in row for row in rows)
    assert "trials" not in text
    assert "the same" in shown(difference_table(one.run, one.run))


def test_listing_does_not_wait_for_pandas(root):
    code = """
import sys
from nsf.cli import main
try:
    main(["runs"])
except SystemExit as end:
    assert not end.code
assert not {"torch", "warp", "hydra", "matplotlib", "pandas"} & set(sys.modules)
"""
    environment = os.environ | {"NSF_RUNS": str(root)}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "8 runs" in done.stderr
