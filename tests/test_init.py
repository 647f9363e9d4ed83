"""`nsf init`: what it writes works from the outside, and it overwrites nothing."""

import os
import re
import subprocess
import sys

import numpy as np
import pytest

from nsf import installed
from nsf.cli import main
from nsf.errors import ConfigError
from nsf.init import write_project
from nsf.pipeline import preview
from nsf.scenes import Mesh

#: A plate of 120 x 60 x 16 mm.
PLATE = "".join(f"v {x} {y} {z}\n" for x in (0, 120) for y in (0, 60) for z in (0, 16)) + (
    "f 1 2 4 3\nf 5 7 8 6\nf 1 5 6 2\nf 3 4 8 7\nf 1 3 7 5\nf 2 6 8 4\n"
)


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


def test_a_project_that_is_not_installed(tmp_path, monkeypatch, capsys):
    write_project(tmp_path / "mine")
    monkeypatch.chdir(tmp_path / "mine")
    monkeypatch.setenv("NSF_CONFIG", "conf")
    with pytest.raises(SystemExit):
        main(["plan", "scene=mine"])
    assert "pip install -e ." in capsys.readouterr().err


@pytest.fixture
def plate(tmp_path, monkeypatch):
    """A project with a mesh of 16 mm thickness, as if it were installed, and its pipeline."""
    (tmp_path / "bracket.obj").write_text(PLATE)
    with pytest.raises(SystemExit) as ended:
        main(["init", str(tmp_path / "dents"), f"mesh={tmp_path / 'bracket.obj'}", "unit=mm"])
    assert not ended.value.code
    dist_info = tmp_path / "dents" / "dents-0.1.0.dist-info"
    dist_info.mkdir()
    (dist_info / "METADATA").write_text("Metadata-Version: 2.1\nName: dents\nVersion: 0.1.0\n")
    (dist_info / "entry_points.txt").write_text("[nsf]\ndents = dents\n")
    monkeypatch.syspath_prepend(tmp_path / "dents")
    monkeypatch.chdir(tmp_path / "dents" / "conf")  # a package of the current folder is not installed
    monkeypatch.setenv("NSF_CONFIG", str(tmp_path / "dents" / "conf"))
    monkeypatch.setenv("NSF_RUNS", str(tmp_path / "runs"))
    for cached in (installed.entry_points, installed.root_of):
        cached.cache_clear()
    path = f"scene.bodies.body.shape.path={tmp_path / 'dents/meshes/bracket.obj'}"
    yield preview.plans([["scene=dents", "device=cpu", path]])[0]
    for cached in (installed.entry_points, installed.root_of):
        cached.cache_clear()
    for name in [name for name in sys.modules if name.partition(".")[0] == "dents"]:
        del sys.modules[name]


def test_a_scene_is_scaled_to_a_mesh(plate):
    scene = plate.scene
    lower, upper = scene.bodies["body"].shape.bounds
    np.testing.assert_allclose(upper - lower, [0.12, 0.06, 0.016])
    assert 2.3 < 0.016 / scene.dx < 2.7
    assert lower[2] > scene.colliders["floor"].point[2] > 0.04
    assert preview.scene_table(plate).row_count > 5


def test_the_mesh_of_the_template_gives_its_scene(tmp_path):
    write_project(tmp_path / "plain")
    mesh = Mesh(str(tmp_path / "plain/meshes/bracket.obj"), unit="mm")
    write_project(tmp_path / "scaled", mesh)
    plain, scaled = (
        [float(n) for n in re.findall(r"\d+\.\d+", re.sub("#.*", "", text))]
        for text in (
            "".join((tmp_path / f"{name}/conf/scene/{file}.yaml").read_text() for file in (name, "body"))
            for name in ("plain", "scaled")
        )
    )
    np.testing.assert_allclose(scaled, plain, rtol=0.05)


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["mesh=none.obj", "unit=mm"], "none.obj is no file"),
        (["mesh={}"], "choose m, cm, mm"),
        (["mesh={}", "unit=inch"], "choose m, cm, mm"),
        (["unit=mm"], "mesh=FILE"),
    ],
)
def test_a_mesh_that_cannot_be_taken(tmp_path, capsys, words, told):
    (tmp_path / "plate.obj").write_text(PLATE)
    words = [word.format(tmp_path / "plate.obj") for word in words]
    with pytest.raises(SystemExit) as ended:
        main(["init", str(tmp_path / "mine"), *words])
    assert ended.value.code == 2
    assert told in capsys.readouterr().err
    assert not (tmp_path / "mine").exists()


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
    run("nsf.cli", "run", "--config-dir", "conf", "scene=my_project", *short, *few)
    assert "2 jobs" in run("nsf.cli", "plan", "--config-dir", "conf", "+experiment=rivals", *short)
    assert "Law" in run("nsf.cli", "point", "--config-dir", "conf", "material=law")
    run("pytest", "-q", "-p", "no:cacheprovider")
