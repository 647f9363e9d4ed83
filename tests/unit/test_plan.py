"""`nsf plan`: what a run would do, said before any work; and what a run says while it works."""

import re
from dataclasses import replace
from types import SimpleNamespace

import pytest
from omegaconf import OmegaConf
from rich.markup import escape

from nsf import progress
from nsf.cli import main
from nsf.config import load
from nsf.pipeline import Pipeline, preview
from nsf.pipeline.durations import FILE, Work, interval, times
from nsf.pipeline.sweeps.outcome import outcome
from nsf.progress import Progress, label, labelled
from nsf.scenes.resolution import resolution_warnings


@pytest.fixture
def nsf(chain, tiny, tmp_path, monkeypatch, capsys):
    """(*words) → exit code and outputs, on the runs of the tiny chain."""
    monkeypatch.setenv("NSF_RUNS", str(chain.root))
    monkeypatch.setenv("NSF_REPORTS", str(tmp_path / "reports"))

    def call(command, *words):
        keys = {word.split("=")[0] for word in words}
        base = [word for word in tiny if word.split("=")[0] not in keys]
        with pytest.raises(SystemExit) as end:
            main([command, *base, *words])
        return (end.value.code or 0, *capsys.readouterr())

    return call


def states(out):
    """State by stage."""
    found = re.findall(r"^(simulate|train|teach|deploy|evaluate) +(.+?)(?:  |$)", out, re.M)
    return {stage: state.strip() for stage, state in found}


def test_a_chain_that_is_there(nsf, chain):
    code, out, _ = nsf("plan")
    assert code == 0
    assert states(out) == {
        "simulate": "all 4 there",
        "train": "there",
        "deploy": "there",
        "evaluate": "there",
    }
    assert re.search(r"particles +500\b", out)
    assert re.search(r"memory +\S+ MiB of a full-order run; 2.57 MiB of 75 training frames", out)
    assert re.search(r"Δt = 0.005 s; up to 0.00\d+ s is stable", out)
    assert "21" not in out.split("test")[0].split("train")[1]
    assert chain.pipeline.training.hash in out


def test_what_is_to_be_made_is_expected_to_take_what_the_like_of_it_took(nsf, chain):
    before = {path for path in chain.root.rglob("*")}
    code, out, _ = nsf("plan", "latent_dim=3")
    assert code == 0
    assert states(out) == {
        "simulate": "all 4 there",
        "train": "to do",
        "deploy": "to do",
        "evaluate": "to do",
    }
    assert "1 time" in out
    assert re.search(r"^in all +[\d.]+–[\d.]+ (s|min)", out, re.M)
    assert {path for path in chain.root.rglob("*")} == before


def test_a_scene_of_a_chain_that_is_there():
    pipeline = Pipeline(load(["scene=cake", "scale=small", "device=cpu"]))  # as of a chain that is there
    shown = preview.scene_table(pipeline)
    assert "12,500" in list(shown.columns[1].cells)


def test_a_coarse_scene_is_warned_of_as_in_a_run():
    pipeline = Pipeline(load(["scene=sand", "device=cpu", "scene.bodies.column.particles=300"]))
    shown = preview.scene_table(pipeline)
    rows = dict(zip(*(list(column.cells) for column in shown.columns), strict=True))
    assert rows["warning"] == escape(resolution_warnings(pipeline.scene)[0])


def test_trajectories_take_what_their_bytes_say(chain, tiny, monkeypatch):
    monkeypatch.setenv("NSF_RUNS", str(chain.root))
    words = [word for word in tiny if not word.startswith("scene.design.train")]
    (names,) = preview.plans([(*words, "scene.design.train=[21,25,35]")])
    stages = {stage.name: stage for stage in preview.stages_of([names])}
    simulate = stages["simulate"]
    of_one = chain.trajectory(26.0).stat().st_size
    assert (len(simulate.runs), simulate.missing) == (4, 3)
    assert simulate.size == pytest.approx(3 * of_one, rel=0.2)
    assert 0 < simulate.time.low < simulate.time.high


def test_a_stage_like_none_before_is_a_guess(nsf, tmp_path, monkeypatch):
    monkeypatch.setenv("NSF_RUNS", str(tmp_path / "none"))
    _, out, _ = nsf("run", "--dry-run")
    assert states(out)["simulate"] == "4 of 4 to do"
    assert re.search(r"^in all .+–.+ a guess *$", out, re.M)
    assert re.search(r"^report +to do", out, re.M)
    assert not (tmp_path / "none").exists()


def test_an_interval_is_narrow_where_like_work_was_measured_often(tmp_path):
    work = Work("train", "sand", "BasisField", "cpu", 10.0)
    guess = interval(work, [])
    often = interval(work, [(work, 30.0)] * 8)
    other = interval(work, [(replace(work, scene="cake"), 30.0)] * 8)
    assert guess.low < 10.0 < guess.high
    assert often.like == "8 times"
    assert often.low < 30.0 < often.high < 2.0 * 30.0
    assert other.like == "8 times, other scenes"
    assert other.low < often.low < often.high < other.high
    assert interval(work, [(replace(work, device="cuda:0"), 30.0)]) == guess
    broken = ("no line,", "", 140_000 * "a", "train,sand,BasisField,cpu,0,nan")
    (tmp_path / FILE).write_text("\n".join(["train,sand,BasisField,cpu,10,30", *broken]))
    assert times(tmp_path) == [(work, 30.0)]


def test_several_jobs_share_their_runs(nsf):
    _, out, _ = nsf("plan", "-m", "latent_dim=3,4")
    assert states(out)["simulate"] == "all 4 there"
    assert states(out)["train"] == "1 of 2 to do"
    assert "2 jobs" in out


def test_the_configuration_is_composed(nsf):
    code, out, _ = nsf("plan", "--cfg", "latent_dim=3")
    assert code == 0
    told = OmegaConf.create(out)
    assert told.latent_dim == 3
    assert told.scene.dx == 0.02
    assert "${" not in out


@pytest.mark.parametrize(
    ("words", "told"),
    [(["latent_dim=0"], "latent_dim=0"), (["scene.dt=0.5"], "unstable"), (["--fast"], "not key=value")],
)
def test_what_a_run_refuses_a_plan_refuses(nsf, words, told):
    code, _, err = nsf("plan", *words)
    assert code == 2
    assert told in err


def test_no_scene_is_told_which_there_are(capsys):
    for command in ("run", "train", "plan"):
        with pytest.raises(SystemExit) as end:
            main([command])
        assert end.value.code == 2
        assert "choose one of block, bread, cake" in capsys.readouterr().err


def test_a_log_gets_a_line_now_and_then(monkeypatch, capsys):
    clock = iter([0.0, 4.0, 10.0, 14.0, 20.5])
    monkeypatch.setattr(progress.time, "monotonic", lambda: next(clock))
    with labelled("latent_dim=4"), Progress("simulate", 100, "frames") as bar:
        bar.describe("φ = 30°")
        for _ in range(4):
            bar.advance(10)
    lines = capsys.readouterr().err.splitlines()
    assert lines == [
        "[latent_dim=4] simulate: φ = 30°, 20 of 100 frames, 1.7/s, 48 s left",
        "[latent_dim=4] simulate: φ = 30°, 40 of 100 frames, 1.8/s, 33 s left",
    ]
    assert label() == ""


def test_a_log_tells_of_work_that_has_not_begun(monkeypatch, capsys):
    monkeypatch.setattr(progress, "EVERY", 0.0)
    with Progress("train", 10, "steps") as bar:
        bar.advance(0)
    assert capsys.readouterr().err == "train, 0 of 10 steps\n"


def test_a_sweep_ends_with_a_table_over_what_it_varied(chain, tiny, monkeypatch):
    monkeypatch.setenv("NSF_RUNS", str(chain.root))
    words = [word for word in tiny if not word.startswith("latent_dim")]
    rows, best = outcome([[*words, "latent_dim=4,3"]], {"latent_dim=3": "lost"})
    columns = dict(zip(rows.headings, zip(*rows.body, strict=True), strict=True))
    assert columns["latent_dim"] == ("4", "3")
    assert columns["run"] == (chain.pipeline.evaluation.hash, "failed")
    assert float(columns["displacement error [%]"][0]) > 0
    assert best == ""  # without validation values
    assert outcome([list(tiny)], {}) is None

    def evaluated(pipeline):
        metrics = {"delta": 0.1, "validation_error": 0.01 * pipeline.config.latent_dim}
        return SimpleNamespace(hash="0", manifest={"metrics": metrics})

    monkeypatch.setattr(Pipeline, "evaluated", evaluated)
    _, best = outcome([[*words, "latent_dim=4,3"]], {})
    assert "3 %" in best.splitlines()[0]
    assert best.splitlines()[1].startswith("nsf run ")
    assert best.endswith("latent_dim=3")
