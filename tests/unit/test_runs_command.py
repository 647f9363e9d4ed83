"""`nsf runs` and its Python twin: what tells runs apart, what may go, and the run of exactly these keys."""

import io
import json
import os
import re

import pandas as pd
import pytest

from nsf import find, runs
from nsf.cli import main
from nsf.errors import ConfigError, MissingRunError
from nsf.runs import Run
from nsf.runs.columns import differing, unit_of
from nsf.runs.listing import entries
from nsf.runs.pruning import prunable
from nsf.runs.reserved import reserved, reserving
from nsf.storage import bytes_text


@pytest.fixture
def root(tmp_path, monkeypatch):
    """A chain with two manifolds, one of them evaluated; a failed training; a needless trajectory."""
    root = tmp_path / "runs"
    monkeypatch.setenv("NSF_RUNS", str(root))
    data = [made("simulate", {"parameters": {"mu": {"key": "material.mu", "value": v}}}) for v in (1.0, 2.0)]
    four, _ = (made("train", {"latent_dim": r, "seed": r - 4}, data) for r in (4, 6))
    deployed = made("deploy", {"model": {"name": "projected"}, "cases": [{"mu": 1.5}]}, [four])
    errors = {"delta": 0.02, "displacement_error": 0.2}
    made("evaluate", {"evaluation": {"trials": 2}}, [deployed], **errors, step_ms=1.5)
    with (
        pytest.raises(ValueError, match="lost"),
        Run.open("train", "sand", {"latent_dim": 8, "seed": 0}, data).record(),
    ):
        raise ValueError("lost")
    made("simulate", {"parameters": {"E": {"key": "material.E", "value": 3.0}}}, scene="jelly")
    return root


def made(stage, config, parents=(), scene="sand", **metrics):
    run = Run.open(stage, scene, config, parents)
    with run.record() as record:
        record.metrics.update(metrics)
        (record.path / "payload").write_bytes(bytes(2048))
        record.output("payload")
    return run


@pytest.fixture
def nsf(capsys):
    def call(*words):
        with pytest.raises(SystemExit) as end:
            main(["runs", *words])
        return (end.value.code or 0, *capsys.readouterr())

    return call


def rows(out):
    return [line.split() for line in out.splitlines() if line.strip()]


def test_columns_are_what_differs_among_the_runs_shown(root, nsf):
    code, out, _ = nsf("stage=train")
    head, *body = rows(out)
    assert code == 0
    assert head[-2:] == ["r", "seed"]
    assert {tuple(row[-2:]) for row in body[:3]} == {("4", "0"), ("6", "2"), ("8", "0")}
    _, out, _ = nsf("stage=simulate", "scene=sand")
    assert rows(out)[0][-1] == "case"
    assert {row[-1] for row in rows(out)[1:3]} == {"1", "2"}
    _, out, _ = nsf("stage=evaluate")
    assert "displacement_error [%]" in out.splitlines()[0]
    assert not {"case", "r", "seed"} & set(rows(out)[0])  # of one run, nothing differs


def test_a_filtered_key_is_shown_although_all_have_it(root, nsf):
    _, out, _ = nsf("stage=evaluate", "evaluation.trials=*", "model=projected")
    assert "evaluation.trials  model" in out
    assert rows(out)[1][-4:-2] == ["2", "projected"]


def test_a_key_that_parts_runs_as_another_does_has_no_column(root):
    for r in (4, 6):
        made(
            "train", {"latent_dim": r, "field": {"noise": 0.1 * r}, "trainer": {"steps": 100 * r}}, scene="x"
        )
    listed = entries({"stage": "train", "scene": "x"})
    assert differing(listed) == ["latent_dim"]
    assert differing(listed, ["field.noise"]) == ["latent_dim", "field.noise"]


def test_a_narrow_terminal_shows_whole_cells_of_fewer_columns(root, nsf, monkeypatch):
    whole = nsf("stage=train")[1]
    monkeypatch.setenv("COLUMNS", "40")
    code, out, _ = nsf("stage=train")
    assert code == 0
    assert max(map(len, out.splitlines())) <= 40
    head, *body = rows(out)
    assert head == ["id", "status", "r", "seed"] != rows(whole)[0]
    assert {"4", "6", "8"} == {row[-2] for row in body[:3]}
    assert all(row[0] in whole for row in body[:3])


def test_cases_of_several_parameters_are_numbered(root, nsf):
    for E in (1.0, 2.0):
        of = {name: {"key": f"material.{name}", "value": v} for name, v in (("E", E), ("nu", 0.3))}
        made("simulate", {"parameters": of}, scene="block")
    _, out, _ = nsf("scene=block")
    assert [row[-1] for row in rows(out)[1:3]] == ["#1", "#2"]
    assert "case #1: E=2, nu=0.3" in out


def test_other_programs_read_json_and_csv(root, nsf):
    listed = json.loads(nsf("stage=evaluate", "--json")[1])
    assert [(row["delta"], row["status"]) for row in listed] == [(0.02, "complete")]
    frame = pd.read_csv(io.StringIO(nsf("stage=train", "sort=latent_dim", "--csv")[1]))
    assert frame["latent_dim"].tolist() == [4, 6, 8]


def test_every_key_has_a_column_and_units_stand_in_attributes(root):
    made("train", {"latent_dim": 4, "field": {"beta": [16, 24, 32]}}, scene="jelly", training_seconds=2.0)
    frame = runs.table(stage="train", scene="jelly")
    assert frame[["field.beta.0", "field.beta.2"]].iloc[0].tolist() == [16, 32]
    assert frame.attrs["units"]["training_seconds"] == "s"
    assert frame["training_seconds"].tolist() == [2.0]


def test_keys_that_only_some_runs_have_are_no_difference(root):
    made("train", {"latent_dim": 4, "seed": 0, "teaching": {"width": 96}})
    assert "teaching.width" not in differing(entries({"stage": "train"}))
    made("train", {"latent_dim": 4, "seed": 0, "teaching": {"width": 48}})
    assert "teaching.width" in differing(entries({"stage": "train"}))


def test_one_run_in_full(root, nsf):
    run = next(e.run for e in entries({"stage": "evaluate"}))
    code, out, _ = nsf("show", run.hash[:8])
    assert code == 0
    assert re.search(r"delta\s+2(\.0+)? %", out)
    assert re.search(r"step_ms\s+1\.50 ms", out)
    assert run.parents[0] in out
    assert re.search(r"payload\s+2 KiB", out)
    (trained,) = (e.run for e in entries({"stage": "train", "latent_dim": "4"}))
    _, out, _ = nsf("show", trained.id)
    assert re.search(r"needed by\s+deploy/sand/\w+\s+complete", out)


def test_a_difference_has_units_and_is_rounded(root, nsf):
    first, second = (
        made("evaluate", {"evaluation": {"trials": t}}, delta=d, step_ms=m)
        for t, d, m in ((3, 0.0123456, 1.23456), (4, 0.0223456, 1.23457))
    )
    code, out, _ = nsf("diff", first.hash, second.hash)
    assert code == 0
    assert any(row[:2] == ["delta", "[%]"] and row[2:4] == ["1.23", "2.23"] for row in rows(out))
    # Rounded they would look alike.
    assert any(row[:2] == ["step_ms", "[ms]"] and row[2:4] == ["1.23456", "1.23457"] for row in rows(out))


def test_units_are_those_of_the_configuration():
    assert unit_of("scene.dx") == "m"
    assert unit_of("material.E") == "Pa"
    assert unit_of("sampler.size") == ""
    assert unit_of("field.depth") == ""
    assert unit_of("training_seconds") == "s"
    assert unit_of("delta") == "%"


def test_prune_takes_what_nothing_complete_needs(root, nsf):
    code, out, err = nsf("prune", "yes=true")
    assert code == 0
    gone = {line.split()[0].rsplit("/", 1)[0] for line in out.splitlines()}
    assert gone == {
        "train/sand",
        "simulate/jelly",
    }  # the failed and the needless manifold; a needless trajectory
    left = {(r.stage, r.scene) for r in Run.find()}
    assert left == {("simulate", "sand"), ("train", "sand"), ("deploy", "sand"), ("evaluate", "sand")}
    assert len(Run.find("train")) == 1
    assert "deleted 3 runs" in err
    assert "KiB" in err
    assert not (root / "simulate/jelly").exists()


def test_prune_keeps_results_and_what_they_need_unless_told(root):
    asked, everything = entries({"scene": "sand"}), Run.find()
    assert not {run.stage for run in prunable(asked, everything)} & {"evaluate", "deploy", "simulate"}
    assert len(prunable(asked, everything, results=True)) == len(asked)
    # One that goes is no reason to keep what it was made from; one that stays is.
    assert [run.stage for run in prunable(entries({"stage": "simulate"}), everything)] == ["simulate"]


def test_what_a_running_sweep_needs_is_kept(root, nsf):
    (run,) = Run.find("simulate", "jelly")
    with reserving([run]):
        assert run not in prunable(entries({}), Run.find())
        assert reserved(root, by_others=True) == set()
        code, _, err = nsf("rm", run.id, "yes=true")
        assert code == 2
        assert "needed by a sweep that is running; wait until it has ended" in err
        assert run.complete
    assert run in prunable(entries({}), Run.find())
    assert not (root / ".reserved").exists()


def test_a_killed_sweep_needs_nothing(root):
    (run,) = Run.find("simulate", "jelly")
    names = root / ".reserved" / "dead.txt"
    names.parent.mkdir()
    names.write_text(run.id)
    assert run in prunable(entries({}), Run.find())
    assert not names.exists()


def test_a_sweep_names_what_it_needs(tmp_path, monkeypatch):
    from nsf.pipeline.sweeps import jobs as sweep

    monkeypatch.setenv("NSF_RUNS", str(tmp_path))
    seen: set[str] = set()

    def in_turn(stages, group, config_name, jobs, first):
        seen.update(reserved(tmp_path))
        return [None] * len(jobs)

    monkeypatch.setattr(sweep, "_in_turn", in_turn)
    jobs = ["scene=sand", "scale=small", "device=cpu", "latent_dim=2,3", "scene.design.train=[21,30,38.5]"]
    assert sweep.sweep([jobs], ("simulate", "train")) == []
    assert sorted(run.split("/")[0] for run in seen if "train/" in run) == ["train", "train"]
    assert sum(run.startswith("simulate/sand/") for run in seen) >= 3
    assert reserved(tmp_path) == set()


def test_prune_by_age(root, nsf):
    code, out, err = nsf("prune", "older=1h", "yes=true")
    assert (code, out) == (0, "")
    assert "nothing to delete" in err
    code, _, err = nsf("prune", "older=soon")
    assert code == 2
    assert "36h, 7d or 2w" in err


@pytest.mark.parametrize(("answer", "left"), [("y", 7), ("", 8), ("no", 8)])
def test_rm_asks_first(root, nsf, monkeypatch, answer, left):
    asked = []
    monkeypatch.setattr("sys.stdin.isatty", lambda: True, raising=False)
    monkeypatch.setattr("builtins.input", lambda text: asked.append(text) or answer)
    code, _, _ = nsf("rm", next(e.run for e in entries({"scene": "jelly"})).hash)
    assert code == 0
    assert "2." in asked[0]
    assert "KiB" in asked[0]
    assert len(Run.find()) == left


def test_rm_says_what_was_made_from_a_run_and_takes_no_silence_for_yes(root, nsf, monkeypatch):
    monkeypatch.setattr("sys.stdin", open(os.devnull))  # noqa: SIM115
    code, _, err = nsf("rm", next(e.run for e in entries({"stage": "train", "latent_dim": "4"})).id)
    assert code == 2
    assert "deploy/sand" in err or "evaluate/sand" in err
    assert "yes=true" in err
    assert len(Run.find()) == 8


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["rm"], "takes the runs"),
        (["rm", "abc"], "begins with, 'abc'"),
        (["rm", "yes=perhaps", "abc"], "must be true or false"),
        (["prune", "yes=perhaps"], "must be true or false"),
        (["prune", "stgae=train"], "did you mean stage"),
        (["prune", "method=nsf"], "method was removed; set stress="),
        (["show"], "takes one run"),
        (["stage=evaluate", "sort=dleta"], "did you mean delta"),
        (["--all"], "'--all' is not key=value"),
        (["diff", "abc"], "takes two runs, not 1"),
    ],
)
def test_what_is_refused(root, nsf, words, told):
    code, _, err = nsf(*words)
    assert code == 2
    assert told in err
    assert len(Run.find()) == 8


def test_a_run_that_is_being_made_stays(root, nsf):
    run = Run.open("train", "jelly", {"latent_dim": 3})
    with run.record():
        code, _, err = nsf("rm", run.id, "yes=true")
        assert code == 2
        assert "being made" in err
        assert run.hash not in nsf("prune", "yes=true")[1]


def test_the_table_is_a_data_frame_with_the_same_filters(root):
    frame = runs.table(stage="train", sort="latent_dim")
    assert list(frame["latent_dim"]) == [4, 6, 8]
    assert list(frame["status"]) == ["complete", "complete", "failed"]
    assert pd.api.types.is_datetime64_any_dtype(frame["created"])
    assert runs.table(stage="evaluate")["delta"].tolist() == [0.02]
    assert len(runs.table("evaluation.trials=2", latent_dim=[4, 6])) == 1
    assert (frame["path"].map(os.path.isdir)).all()
    with pytest.raises(ConfigError, match="no run can have scene=mars"):
        runs.table(scene="mars")
    with pytest.raises(ConfigError, match="did you mean stage"):
        runs.table(stgae="train")


def test_find_gives_the_run_of_exactly_these_keys(chain, tiny):
    words = [word for word in tiny if word.split("=")[0] not in ("scene", "latent_dim")]
    found = find(*words, scene="sand", latent_dim=4, root=chain.root)
    assert found == chain.pipeline.training
    evaluated = find(*words, stage="evaluate", scene="sand", latent_dim=4, root=chain.root)
    assert evaluated == chain.pipeline.evaluation
    with pytest.raises(MissingRunError, match="is not there"):
        find(*words, scene="sand", latent_dim=5, root=chain.root)
    with pytest.raises(ConfigError, match="name a scene"):
        find(latent_dim=4, root=chain.root)
    with pytest.raises(ConfigError, match="stage=report"):
        find(scene="sand", stage="report")


def test_bytes_are_shown_in_a_unit_of_their_size():
    assert [bytes_text(n) for n in (0, 2048, 5e6, 3e9)] == ["0 B", "2 KiB", "4.77 MiB", "2.79 GiB"]
