"""README says what is so: its commands compose, its example runs, its figures are the report's."""

import re
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from pages import ROOT, blocks_of, try_command

from nsf import config
from nsf.errors import ConfigError
from nsf.pipeline import Pipeline
from nsf.reporting import COLUMNS
from nsf.reporting.committed import BEGIN, END, REPORT, figures, updated

README = (ROOT / "README.md").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    "command", [line for block in blocks_of(README, "sh") for line in block.splitlines()]
)
def test_readme_command(command, tmp_path, monkeypatch, capsys):
    try_command(command, tmp_path, monkeypatch, capsys)


def test_readme_python_runs(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("NSF_RUNS", str(tmp_path))
    # The example's particles, so that its manifold fits; few steps and values.
    scene = ["scene.steps=8", "scene.parameters.train=[21.0,30.0,38.5]", "scene.parameters.test=[26.0]"]
    pipeline = Pipeline(config.load(["scene=sand", "scale=small", "device=cpu", "trainer.steps=20", *scene]))
    pipeline.simulate()
    pipeline.train()
    capsys.readouterr()
    (block,) = blocks_of(README, "python")
    exec(compile(block, "README.md", "exec"), {"__name__": "readme"})
    assert len(capsys.readouterr().out.split("\n")) == 3


def test_readme_scene_builds(tmp_path, monkeypatch):
    """The scene with a mesh of one's own, as README shows it."""
    trimesh = pytest.importorskip("trimesh")
    shutil.copytree(config.CONF, tmp_path / "conf")
    (block,) = blocks_of(README, "yaml")
    (tmp_path / "conf/scene/bunny.yaml").write_text(block)
    monkeypatch.setattr(config, "CONF", tmp_path / "conf")
    monkeypatch.chdir(tmp_path)
    trimesh.creation.icosphere(subdivisions=2).export("bunny.obj")
    pipeline = Pipeline(config.load(["scene=bunny", "scale=small", "device=cpu"]))
    assert pipeline.scene.material.yield_stress == 50.0
    assert np.ptp(pipeline.scene.particles().X[:, 2]) == pytest.approx(0.25, rel=0.1)
    assert pipeline.held_out == (30.0, 70.0)


def test_readme_links_lead_somewhere():
    links = re.findall(r"\]\(([^)]+)\)", README) + re.findall(r'(?:href|src)="([^"]+)"', README)
    links = [link for link in links if not link.startswith(("http", "#"))]
    named = re.findall(r"`((?:nsf|conf|docs|experiments)/[\w/.]+)`", README)
    assert links
    assert named
    for path in (*links, *named):
        assert (ROOT / path).exists(), path


def test_readme_figures_are_those_of_the_report(monkeypatch):
    monkeypatch.chdir(ROOT)
    assert updated(README, REPORT) == README, "run `make readme`"


def results(tmp_path: Path, deltas: dict[str, float]) -> Path:
    rows = [
        dict.fromkeys(COLUMNS, 1.0)
        | {
            "scene": "sand",
            "method": method,
            "field": "basis",
            "split": split,
            "device": "cpu",
            "precision": "fp64",
        }
        | {"parameter": value, "delta": delta * scale, "commit": "abc"}
        for method, delta in deltas.items()
        for value, split, scale in ((26.0, "test", 0.5), (33.0, "test", 1.5), (21.0, "train", 99.0))
    ]
    pd.DataFrame(rows, columns=list(COLUMNS)).to_csv(tmp_path / "results.csv", index=False)
    return tmp_path


def test_figures_are_means_of_held_out_values(tmp_path):
    text = figures(results(tmp_path, {"nsf": 0.00123, "deformation_only": 0.0456}))
    assert "| sand | nsf | 0.400 | 0.123 |" in text  # the paper's, then ours
    assert "| sand | deformation_only | – | 4.56 |" in text
    assert "paper's δ [%] | δ [%]" in text


def test_figures_show_the_scenes_that_have_a_picture(tmp_path):
    folder = results(tmp_path, {"nsf": 0.00123})
    assert "<table>" not in figures(folder)
    (folder / "sand-nsf-strip.png").touch()
    assert figures(folder).count('<img src="') == 1
    assert "Sand column" in figures(folder)


def test_figures_do_not_hide_divergence(tmp_path):
    assert "| sand | nsf | 0.400 | ∞ |" in figures(
        results(tmp_path, {"nsf": float("inf"), "deformation_only": 0.01})
    )


def test_figures_need_their_markers(tmp_path):
    assert updated(f"a\n{BEGIN}\nold\n{END}\nb", tmp_path).startswith(f"a\n{BEGIN}\n`")
    for text in ("", BEGIN, END + BEGIN, BEGIN + END + END):
        with pytest.raises(ConfigError, match="once each"):
            updated(text, tmp_path)
