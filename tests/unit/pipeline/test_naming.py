"""A run is named by the values that determine it, and by nothing else."""

import shutil

import pytest

from nsf import config
from nsf.pipeline import Pipeline

TETRAHEDRON = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
STAGES = ("simulate", "train", "deploy", "evaluate")


def names(*overrides: str, scene: str = "sand") -> dict[str, list[str]]:
    pipeline = Pipeline(config.load([f"scene={scene}", "scale=small", "device=cpu", *overrides]))
    return {stage: [run.id for run in pipeline.runs_of(stage)] for stage in STAGES}


@pytest.mark.parametrize(
    "overrides",
    [
        ["scene.title=Another title"],
        ["material.friction_angle=31.0"],  # replaced by each case
        ["scene.gravity=[0,0,-4]"],
        ["+scene.bodies.column.weakness=null"],  # as it is by default
        ["report.name=elsewhere"],
        ["data.resident=true"],
        ["scene.walls.kind=separate"],
    ],
    ids=lambda overrides: overrides[0],
)
def test_a_key_that_changes_nothing_renames_nothing(overrides):
    assert names(*overrides) == names()


@pytest.mark.parametrize(
    ("override", "first"),
    [
        ("scene.dt=0.003", "simulate"),
        ("material.nu=0.21", "simulate"),
        ("scene.bodies.column.weakness={_target_: nsf.scenes.Weakness, region: "
         "{_target_: nsf.scenes.Ball, centre: [0.5, 0.5, 0.2], radius: 0.05}}", "simulate"),
        ("latent_dim=5", "train"),
        ("sampler.size=90", "deploy"),
        ("evaluation.trials=1", "evaluate"),
    ],
)  # fmt: skip
def test_a_value_renames_its_stage_and_those_after_it(override, first):
    before, after = names(), names(f"++{override}")
    renamed = [stage for stage in STAGES if not set(after[stage]) & set(before[stage])]
    assert renamed == list(STAGES[STAGES.index(first) :])


def test_a_mesh_enters_by_its_content(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "x.obj").write_text(TETRAHEDRON)
    (tmp_path / "below").mkdir()
    shutil.copyfile("x.obj", "below/copy.obj")
    paths = ("x.obj", "./x.obj", str(tmp_path / "x.obj"), "below/copy.obj")
    one, *others = (names(f"scene.geometry.mesh={path}", scene="drop") for path in paths)
    assert others == [one] * 3
    (tmp_path / "x.obj").write_text(TETRAHEDRON.replace("0 0 1", "0 0 2"))
    assert not set(one["simulate"]) & set(names("scene.geometry.mesh=x.obj", scene="drop")["simulate"])


def test_encoded_runs_are_among_what_a_sweep_needs():
    pipeline = Pipeline(config.load(["scene=tray", "scale=small", "device=cpu", "model=recurrence"]))
    assert {pipeline.encoding, pipeline.taught} <= set(pipeline.inputs)
