"""`nsf init`: what it writes works from the outside, and it overwrites nothing."""

import os
import subprocess
import sys

import pytest

from nsf.cli import main
from nsf.errors import ConfigError
from nsf.init import write_project


def test_it_overwrites_nothing(tmp_path, capsys):
    (tmp_path / "mine").mkdir()
    with pytest.raises(SystemExit) as ended:
        main(["init", str(tmp_path / "mine")])
    assert not ended.value.code
    files = {path: path.read_bytes() for path in (tmp_path / "mine").rglob("*") if path.is_file()}
    assert not [path for path, text in files.items() if b"PROJECT" in text or "PROJECT" in str(path)]
    with pytest.raises(ConfigError, match="is there already"):
        write_project(tmp_path / "mine")
    assert files == {path: path.read_bytes() for path in files}


@pytest.mark.parametrize(
    ("name", "told"), [("numpy", "is installed"), ("1st", "cannot name"), ("if", "cannot name")]
)
def test_names_of_no_package(tmp_path, name, told):
    with pytest.raises(ConfigError, match=told):
        write_project(tmp_path / name)
    assert not any(tmp_path.iterdir())


@pytest.mark.slow
def test_a_project_is_installed_and_run(tmp_path):
    """Its law, scene, mesh, experiment and test, from a wheel of it beside this installation."""
    project, target = tmp_path / "my-project", tmp_path / "installed"
    write_project(project)
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-build-isolation"]
    subprocess.run([*pip, "--target", target, project], check=True)
    path = os.pathsep.join(filter(None, (str(target), os.environ.get("PYTHONPATH"))))
    outside = {k: v for k, v in os.environ.items() if not k.startswith("NSF_")}  # runs are in the project
    environment = outside | {"PYTHONPATH": path}

    def run(*words: str) -> str:
        command = [sys.executable, "-m", *words]
        done = subprocess.run(command, cwd=project, env=environment, capture_output=True, text=True)
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    short = ["device=cpu", "trainer.steps=20", "scene.steps=8"]
    few = ["model.runs=4", "model.stress=4", "model.descents=20"]
    run("nsf.cli", "run", "--config-dir", "conf", "scene=bracket", *short, *few)
    assert "2 jobs" in run("nsf.cli", "plan", "--config-dir", "conf", "+experiment=bracket", *short)
    values = ["material.yield_stress=40", "material.saturation=200"]
    assert "Saturating" in run("nsf.cli", "point", "--config-dir", "conf", "material=saturating", *values)
    run("pytest", "-q", "-p", "no:cacheprovider")
