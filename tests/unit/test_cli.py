"""The command line: exit codes, one clear line for bad input, the material point."""

import os
import re
import signal
import subprocess
import sys

import pandas as pd
import pytest
import torch

from nsf.cli import STAGES, TOOLS, main
from nsf.paths import groups


@pytest.fixture
def nsf(tmp_path, monkeypatch, capsys, tiny):
    """(*arguments) → (exit code, standard output, standard error) with empty folders of runs and reports."""
    monkeypatch.setenv("NSF_RUNS", str(tmp_path / "runs"))
    monkeypatch.setenv("NSF_REPORTS", str(tmp_path / "reports"))
    monkeypatch.chdir(tmp_path)

    def call(stage, *overrides, tiny_scene=True):
        keys = {o.split("=")[0].lstrip("~+") for o in overrides}
        base = [t for t in tiny if t.split("=")[0] not in keys] if tiny_scene else []
        with pytest.raises(SystemExit) as end:
            main([stage, *base, *overrides])
        return (end.value.code or 0, *capsys.readouterr())

    handler = signal.getsignal(signal.SIGTERM)
    yield call
    signal.signal(signal.SIGTERM, handler)


def files(folder):
    return [p for p in folder.rglob("*") if p.is_file()]


@pytest.mark.parametrize("arguments", [[], ["--help"], ["-h"], ["help"]])
def test_help(arguments, capsys):
    with pytest.raises(SystemExit) as end:
        main(arguments)
    out = capsys.readouterr().out
    assert end.value.code == 0
    assert {*STAGES, *TOOLS} <= set(out.split())


@pytest.mark.parametrize("command", [(), *((name,) for name in (*STAGES, *TOOLS))])
def test_help_fits_a_terminal_of_80_columns(command, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    with pytest.raises(SystemExit) as end:
        main([*command, "--help"])
    assert end.value.code == 0
    assert max(map(len, capsys.readouterr().out.splitlines())) <= 80


@pytest.mark.parametrize("stage", ["run", "point"])
def test_help_of_a_stage(nsf, stage):
    code, out, _ = nsf(stage, "--help", tiny_scene=False)
    assert code == 0
    assert f"usage: nsf {stage}" in out
    assert "device: " in out
    unwrapped = " ".join(out.split())
    assert all(f" {group} {' '.join(options)} " in unwrapped for group, options in groups().items())


def test_a_reader_that_has_enough_is_no_error():
    """As with `nsf --help | head`."""
    read, write = os.pipe()
    os.close(read)
    done = subprocess.run([sys.executable, "-m", "nsf.cli", "--help"], stdout=write, stderr=subprocess.PIPE)
    os.close(write)
    assert (done.returncode, done.stderr) == (1, b"")


def test_version(capsys):
    with pytest.raises(SystemExit) as end:
        main(["--version"])
    assert end.value.code == 0
    assert re.fullmatch(r"\d+\.\d+\S*\n", capsys.readouterr().out)


REFUSED = [
    ("run", "latent_dim", ["'latent_dim' is not key=value"]),
    ("run", "--fast", ["'--fast' is not key=value"]),
    ("run", "scale=big", ["scale=big", "choose small or paper"]),
    ("run", "device=gpu", ["device=gpu"]),
    ("run", "deploy.split=foo", ["deploy.split=foo", "test, validation or train"]),
    ("point", "path=pull", ["path=pull", "simple_shear"]),
    ("point", "point.amplitude=abc", ["point.amplitude=abc"]),
    ("point", "point.rate=0", ["point.rate=0"]),
]


@pytest.mark.parametrize(("stage", "override", "quoted"), REFUSED, ids=[f"{s} {o}" for s, o, _ in REFUSED])
def test_bad_input_is_one_clear_line(nsf, tmp_path, stage, override, quoted):
    code, _, err = nsf(stage, override, tiny_scene=stage == "run")
    assert code == 2
    assert err.startswith("error: ")
    assert len(err.strip().splitlines()) == 1
    for text in quoted:
        assert text in err
    assert not files(tmp_path)


MALFORMED = [
    ("scene.bodies=null", "scene.bodies=null must map names to nodes"),
    ("scene.walls=null", "scene.walls names no class; give it a _target_: nsf.mpm."),
    ("scene.bodies.column.density=inf", "scene.bodies.column.density=inf must be finite"),
    ("scene.bodies.column.particles=true", "particles=True must be a whole number or null"),
    ("~scene.bodies.column.density", "scene.bodies.column.density is missing"),
    ("~scene.gravity", "scene.gravity is missing from the configuration; give it a value"),
    ("scene.size=null", "scene.size=null m must be 3 finite numbers"),
    ("~reduction", "field.members: it refers to reduction.members, which is missing"),
    ("scene.bodies.colum.density=1", "unknown key 'scene.bodies.colum'; did you mean scene.bodies.column?"),
    ("scene.bodies.column._target_=nsf.scenes.Ball", "nsf.scenes.Ball is no Body; name one of nsf.scenes"),
    ("scene.walls._target_=nsf.mpm.HalfSpace", "nsf.mpm.HalfSpace is no DomainWalls; name one of nsf.mpm"),
    ("transfer._target_=nsf.mpm.Trnsfer", "does not exist; did you mean nsf.mpm.Transfer?"),
    ("~scene.walls", "scene.walls is missing from the configuration; give it a value"),
    ("scene.gravity.q=1", "cannot be composed with scene.gravity.q=1: "),
    ("scene.parameters=null", "scene.parameters=null must map keys to values"),
    ("scene.design.test=null", "scene.design.test=None must be a list, as [None]"),
    ("scene.paper={nsf:{delta:a}}", "scene.paper.nsf.delta=a must be a finite number"),
    ("scene=null", "scene=null names no option of its group"),
    ("material=5", "material=5 names no option of its group"),
    ("scene=../../etc/passwd", "unknown scene=../../etc/passwd; choose one of block, bread"),
    ("scene.colliders.floor=[]", "scene.colliders.floor=[]: Cannot merge DictConfig with ListConfig"),
    ("data=null", "data=null must map keys to values"),
    ("~deploy.split", "deploy.split is missing from the configuration"),
    ("report.folder=5", "report.folder=5 must be text"),
    ("seed=1e400", "seed=inf must be a whole number"),
    ("deploy.dt_multiplier=1e-300", "deploy.dt_multiplier=1e-300 must be a finite number of at least 0.001"),
    ("deploy.changes={5:5}", "deploy.changes has the key 5; give dotted keys"),
    (
        "deploy.changes={material:{_target_:os.system}}",
        "deploy.changes.material: _target_: os.system is refused",
    ),
    ("+scene.x='${scene.x}'", "scene.x: it refers to itself"),
    ("+scene.x='${scaled:5}'", "scene.x: ${scaled:5} has no values by scale"),
    ("+scene.x='${per:1,2}'", "scene.x: per() takes 1 positional argument"),
]


@pytest.mark.parametrize(("override", "told"), MALFORMED, ids=[o for o, _ in MALFORMED])
def test_a_malformed_value_is_one_line_that_names_it(nsf, tmp_path, override, told):
    code, _, err = nsf("simulate", override)
    assert code == 2
    assert err.startswith("error: ")
    assert told in err
    assert len(err.strip().splitlines()) == 1
    assert not files(tmp_path)


@pytest.mark.parametrize(
    ("override", "told"),
    [
        ("point=null", "point=null must map keys to values"),
        ("point.points=2000000000", "point.points=2000000000 is more than"),
        ("material._target_=nsf.workers.Worker", "nsf.workers.Worker is refused"),
    ],
)
def test_a_malformed_material_point_is_one_line(nsf, override, told):
    code, _, err = nsf("point", override, tiny_scene=False)
    assert (code, len(err.strip().splitlines())) == (2, 1)
    assert told in err


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["search=null"], "search=null must map keys to values"),
        (["search.objectives=[[a]]"], "search.objectives=[['a']] must list one or more of"),
        (["search.objectives=[step_ms]", "evaluation=null"], "evaluation=null must map keys to values"),
    ],
)
def test_a_malformed_search_is_one_line(nsf, words, told):
    pytest.importorskip("optuna", reason="optuna is not installed")
    code, _, err = nsf("search", "seed=0..3", *words)
    assert (code, len(err.strip().splitlines())) == (2, 1)
    assert told in err


def test_an_error_steers_no_terminal(nsf):
    """A value that quotes control characters is shown with their names."""
    from nsf.errors import ConfigError, DeviceError

    for kind in (ConfigError, DeviceError):
        assert str(kind("a\x1b[31mb\nc\u202ed")) == "a\\x1b[31mb\\nc\\u202ed"


# What later stages need is known from the start: minutes of simulating and training must not be spent first.
BEFORE_ANY_WORK = [
    (
        "sampler.size=1",
        ["|S|=1 gives 3 equations for r=4 unknowns; choose sampler.size >= 2 or latent_dim <= 3"],
    ),
    ("sampler.size=501", ["sampler.size=501", "500 particles"]),
    ("deploy.dt_multiplier=0", ["dt_multiplier=0"]),
    ("deploy.batch=0", ["deploy.batch=0"]),
    ("deploy.changes={scene.bodies.column.particles:400}", ["column.particles", "other particles"]),
    ("deploy.changes={material.nu:0.6}", ["deploy.changes", "material.nu=0.6"]),
    ("evaluation.trials=-1", ["evaluation.trials=-1"]),
    ("super_resolution.factor=1", ["super_resolution.factor=1", "at least 2"]),
    ("evaluation.picture_particles=0", ["evaluation.picture_particles=0"]),
    ("report.name=../elsewhere", ["report.name=../elsewhere", "report.folder"]),
    ("report.folder=/proc/reports", ["no report can be written to /proc/reports", "set report.folder"]),
    ("tracking=sacred", ["tracking=sacred", "tensorboard"]),
]


@pytest.mark.parametrize(("override", "quoted"), BEFORE_ANY_WORK, ids=[o for o, _ in BEFORE_ANY_WORK])
def test_bad_input_of_a_later_stage_is_refused_before_any_work(nsf, monkeypatch, override, quoted):
    monkeypatch.setattr(simulation_stage(), "make", lambda *arguments: pytest.fail("simulate began"))
    code, _, err = nsf("run", override)
    assert code == 2
    assert len(err.strip().splitlines()) == 1
    for text in quoted:
        assert text in err


@pytest.mark.parametrize("jobs", [("+experiment=table1/ablation", "scale=small"), ("-m", "latent_dim=4,5")])
def test_a_place_for_no_report_is_refused_before_the_jobs(nsf, monkeypatch, jobs):
    monkeypatch.setattr(simulation_stage(), "make", lambda *arguments: pytest.fail("simulate began"))
    code, _, err = nsf("run", *jobs, "report.folder=/proc/reports", tiny_scene=jobs[0] == "-m")
    assert code == 2
    assert len(err.strip().splitlines()) == 1
    assert "no report can be written to /proc/reports" in err


def simulation_stage():
    from nsf.pipeline.stages import simulation

    return simulation


def test_what_is_not_deployed_together_is_refused_before_any_work(nsf):
    code, _, err = nsf("run", "deploy.batch=2", "integration=search")
    assert code == 2
    assert "deploy.batch=2 needs integration=superset; set it" in err
    assert "deploy.batch=1" in err


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU here")
def test_a_gpu_where_there_is_none(nsf, tmp_path):
    code, _, err = nsf("run", "device=cuda")
    assert code == 2
    assert "device=cuda" in err
    assert "device=cpu" in err
    assert not files(tmp_path)


def test_an_unstable_step_names_the_largest_stable_one(nsf, tmp_path):
    code, _, err = nsf("simulate", "scene.dt=0.5", "scene.design.train=[30,31]")
    assert code == 2
    assert "dt=0.5 s is unstable" in err
    assert not files(tmp_path)
    largest = re.search(r"largest stable dt is (\S+) s", err).group(1)
    assert nsf("simulate", f"scene.dt={largest}", "scene.design.train=[30,31]")[0] == 0
    longer = 1.001 * float(largest)
    assert nsf("simulate", f"scene.dt={longer}", "scene.design.train=[30,31]")[0] == 2


@pytest.mark.parametrize(
    ("stage", "near"), [("simulat", "simulate"), ("rum", "run"), ("xyz", "choose one of")]
)
def test_unknown_stage(nsf, stage, near):
    code, _, err = nsf(stage, tiny_scene=False)
    assert code == 2
    assert f"unknown command '{stage}'" in err
    assert near in err


def test_point_gives_the_laws_values(nsf, tmp_path):
    """physics.md: Hencky at γ = 0.2, E = 1e6, ν = 0.3."""
    code, out, _ = nsf("point", "material=hencky", "path=simple_shear", tiny_scene=False)
    assert code == 0
    assert {path.rsplit(".")[-1] for path in re.findall(r"\S+simple_shear\.\w+", out)} >= {"png", "csv"}
    (table,) = (tmp_path / "reports/point").glob("*.csv")
    last = pd.read_csv(table).iloc[-1]
    assert last["amplitude"] == pytest.approx(0.2)
    assert last["tau_xy"] == pytest.approx(76414.324119, rel=1e-9)
    assert last["tau_xx"] == pytest.approx(7641.432412, rel=1e-9)


def test_a_law_of_a_user_keeps_its_stiffness_at_a_point(nsf, tmp_path, monkeypatch):
    (tmp_path / "conf/material").mkdir(parents=True)
    law = "_target_: nsf.mpm.materials.Hencky\nE: 1000.0\nnu: 0.3\n"
    (tmp_path / "conf/material/soft.yaml").write_text(law)
    monkeypatch.setenv("NSF_CONFIG", str(tmp_path / "conf"))
    words = (["material=soft"], ["material=hencky", "material.E=1000"])
    said = [nsf("point", *keys, tiny_scene=False)[1].splitlines()[0] for keys in words]
    assert said[0] == said[1]


def test_extremes_of_a_point_are_those_of_the_whole_path(nsf):
    """A cyclic path ends where it began, with next to no stress."""
    _, out, _ = nsf("point", "material=hencky", "path=cyclic_shear", "point.points=21", tiny_scene=False)
    assert float(out.splitlines()[0].split("up to ")[1].split()[0]) > 1e4


def test_a_folder_that_cannot_be_written_is_told(nsf, tmp_path):
    (tmp_path / "reports").touch()
    code, _, err = nsf("point", tiny_scene=False)
    assert code == 2
    assert "cannot write" in err
    assert "NSF_REPORTS" in err


def test_reports_that_are_as_they_were_are_told_so(nsf, tmp_path):
    (tmp_path / "none").mkdir()
    assert nsf("reports", "folder=none", tiny_scene=False)[0] == 0
    code, out, _ = nsf("reports", "folder=none", "check=true", tiny_scene=False)
    assert code == 0
    assert out == "every report in none is as it was generated\n"


@pytest.mark.parametrize("check", ["false", "true"])
def test_a_folder_of_reports_that_is_not_there(nsf, tmp_path, check):
    code, _, err = nsf("reports", "folder=report", f"check={check}", tiny_scene=False)
    assert code == 2
    assert err.startswith("error: folder=report is no folder; name one")
    assert not (tmp_path / "report").exists()
