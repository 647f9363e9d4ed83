"""Folders of configurations of the user stand before ours, for every command."""

import os
import subprocess
import sys

import pytest

from nsf import config, paths
from nsf.cli import main
from nsf.errors import ConfigError
from nsf.pipeline.sweeps.experiment import Experiment

SCENE = """\
# @package _global_
defaults: [sand]
scene: {name: dune, steps: 3}
"""
EXPERIMENT = "{title: t, question: q, paper: p, jobs: [{scene: dune}]}\n"


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.delenv(paths.VARIABLE, raising=False)
    for name, text in {"scene/dune": SCENE, "experiments/dunes": EXPERIMENT, "transfer/apic": APIC}.items():
        path = tmp_path / "own" / f"{name}.yaml"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return tmp_path / "own"


APIC = "_target_: nsf.mpm.Transfer\nscheme: apic\nshape: cubic\ndamping: 0.0\ndeterministic: false\n"


def told(capsys, *arguments) -> str:
    with pytest.raises(SystemExit) as exit_:
        main(arguments)
    assert exit_.value.code == 2
    text = capsys.readouterr().err
    assert len(text.splitlines()) == 1
    return text


@pytest.mark.parametrize("how", ["--config-dir=DIR", "NSF_CONFIG"])
def test_its_groups_and_experiments_come_first(folder, monkeypatch, capsys, how):
    monkeypatch.chdir(folder.parent)
    words = how.replace("DIR", "own").split()
    if how == "NSF_CONFIG":
        words = []
        monkeypatch.setenv(paths.VARIABLE, "own")
    monkeypatch.setenv(paths.VARIABLE, os.environ.get(paths.VARIABLE, ""))
    with pytest.raises(SystemExit) as exit_:
        main(["plan", *words, "scene=dune", "--cfg"])
    assert exit_.value.code == 0
    text = capsys.readouterr().out
    assert all(value in text for value in ("name: dune", "steps: 3", "shape: cubic"))
    assert {"dune", "sand"} <= set(paths.groups()["scene"])
    assert [job.overrides for job in Experiment.load("dunes").jobs] == [("scene=dune",)]
    assert {("scene=drop",), ("scene=dune",)} <= set(config.jobs([["scene=glob(d*)"]]))
    assert config.load(["model=auto"]).transfer.shape == "cubic"


def test_what_is_wrong_with_a_folder(folder, capsys, monkeypatch):
    monkeypatch.setenv(paths.VARIABLE, "")
    (folder.parent / "empty").mkdir()
    assert "is no folder" in told(capsys, "plan", "--config-dir", "/no/such/folder", "scene=dune")
    assert "--config-dir needs a folder" in told(capsys, "plan", "scene=sand", "--config-dir")
    monkeypatch.setenv(paths.VARIABLE, "")
    assert "has no groups" in told(capsys, "run", "--config-dir", str(folder.parent / "empty"), "scene=sand")
    monkeypatch.setenv(paths.VARIABLE, "")
    (folder.parent / "two/scene").mkdir(parents=True)
    (folder.parent / "two/scene/dune.yaml").write_text(SCENE)
    both = ["--config-dir", str(folder), "--config-dir", str(folder.parent / "two")]
    assert "both have scene/dune.yaml" in told(capsys, "run", *both, "scene=dune")
    monkeypatch.setenv(paths.VARIABLE, "")
    (folder / "hydra").mkdir()
    assert "hydra is refused" in told(capsys, "run", "--config-dir", str(folder), "scene=dune")


def test_a_search_path_of_hydra_is_refused(folder, capsys, monkeypatch):
    assert "--config-dir DIR" in told(capsys, "run", f"hydra.searchpath=[file://{folder}]", "scene=dune")
    assert "--config-dir DIR" in told(capsys, "run", "-m", f"+hydra.searchpath=[{folder}]", "scene=dune")
    text = f"# @package _global_\ndefaults: [drop]\nhydra: {{searchpath: ['{folder}']}}\n"
    (folder / "scene/other.yaml").write_text(text)
    monkeypatch.setenv(paths.VARIABLE, str(folder))
    with pytest.raises(ConfigError, match="--config-dir DIR"):
        config.load(["scene=other"])


@pytest.mark.slow
def test_jobs_in_other_processes_have_it_too(folder):
    words = ["run", "-m", "scene=dune", "hydra/launcher=joblib", "trainer.steps=5", "device=cpu"]
    environment = os.environ | {"NSF_RUNS": str(folder / "runs"), "NSF_REPORTS": str(folder / "reports")}
    command = [
        sys.executable,
        "-m",
        "nsf.cli",
        *words,
        "scene.steps=5",
        "scene.bodies.column.particles=300",
        "latent_dim=2",
    ]
    subprocess.run([*command, "--config-dir", str(folder), "seed=0,1"], env=environment, check=True)


def test_a_folder_that_is_not_named_is_hinted_at(folder, monkeypatch, capsys):
    monkeypatch.setenv(paths.VARIABLE, "")
    folder.rename(folder.with_name("conf"))
    monkeypatch.chdir(folder.parent)
    assert "conf has it: add --config-dir conf" in told(capsys, "run", "scene=dune")
    assert "/conf?" in told(capsys, "run", "--config-dir", ".", "scene=dune")
