"""A scene of two parameters through every stage, whose cases a design draws."""

import numpy as np
import pandas as pd
import pytest

from nsf.data import Trajectory
from nsf.deployment import Rollout, rollout_file
from nsf.errors import ConfigError
from nsf.export.playback import Playback
from nsf.results.charts import CHARTS

TWO = (
    "+scene.parameters.friction_angle.range=[22,38]",
    "+scene.parameters.E={key:material.E,unit:Pa,range:[1500,2500],log:true}",
    "scene.design={_target_:nsf.scenes.Sobol,train:4,validation:0,test:2}",
    "evaluation.trials=0",
)


@pytest.fixture(scope="module")
def made(pipeline_at, tmp_path_factory):
    folder = tmp_path_factory.mktemp("two")
    said = []
    pipeline = pipeline_at(folder / "runs", *TWO, f"report.folder={folder / 'reports'}", say=said.append)
    for stage in ("simulate", "train", "deploy", "evaluate"):
        pipeline.run(stage)
    return pipeline, said


def test_each_trajectory_is_of_its_case(made):
    pipeline, said = made
    assert any("simulate: 6 trajectories" in line for line in said)
    for case in pipeline.split.cases:
        with Trajectory.open(pipeline.simulation(case).file("trajectory.h5")) as trajectory:
            assert trajectory.parameters == dict(case)


def test_the_heads_see_both_parameters(made):
    manifold = made[0].manifold()
    assert manifold.parameter_names == ("E", "friction_angle")
    assert len(np.unique(manifold.training_parameters.numpy(), axis=0)) == 4
    at, xhat = manifold.restrict(), manifold.training_latents[20]
    middle = manifold.training_parameters.double().mean(0).to(xhat)
    for change in ([300.0, 0.0], [0.0, 5.0]):
        other = middle + middle.new_tensor(change)
        assert (at.stress(xhat, other) - at.stress(xhat, middle)).abs().max() > 0


def test_a_solver_knows_both_parameters(made):
    pipeline, _ = made
    case = pipeline.held_out[0]
    solver = pipeline.solver_at(pipeline.manifold(), case)
    law = solver.scene.material
    assert (law.friction_angle, law.E) == case.numbers
    assert solver.setup.parameters.tolist() == [case["E"], case["friction_angle"]]


def test_results_name_the_cases(made):
    pipeline, _ = made
    path = pipeline.evaluation.path
    results = pd.read_csv(path / "results.csv")
    assert results["case"].tolist() == [case.named for case in pipeline.held_out]
    assert set(pd.read_csv(path / "series.csv")["case"]) == set(results["case"])
    assert (results["delta"] < 0.02).all()
    rollouts = [Rollout.open(pipeline.deployment.path / f"rollout_{k}.h5") for k in range(2)]
    assert [rollout.case for rollout in rollouts] == list(pipeline.held_out)
    assert [rollout.case.units for rollout in rollouts] == [("°", "Pa")] * 2


def test_a_report_names_the_cases(made, monkeypatch):
    monkeypatch.setattr("nsf.results.pictures._MANY", 0)  # a picture of a variant
    charts = {name: CHARTS[name] for name in ("delta", "latent")}
    monkeypatch.setattr("nsf.results.report.CHARTS", charts)
    pipeline, _ = made
    page = pipeline.report()
    text = page.read_text()
    assert all(case.named in text for case in pipeline.held_out)
    assert len(list(page.parent.glob("*.png"))) >= 3


def test_a_case_is_exported_that_is_the_nearest(made):
    pipeline, _ = made
    second = pipeline.held_out[1]
    near = f"E={second['E'] + 1:.0f},friction_angle={second['friction_angle'] + 0.1:.1f}"
    playback = Playback(pipeline.deployment, near, device="cpu")
    assert playback.case == second
    assert playback.name == second.label
    assert playback.parameters == [second["E"], second["friction_angle"]]
    assert Playback(pipeline.deployment, dict(second), points=600, device="cpu").case == second
    with pytest.raises(ConfigError, match="parameter=26 was not deployed; choose one of friction_angle="):
        Playback(pipeline.deployment, "26", device="cpu")


def test_both_parameters_are_steered(made):
    from nsf.live.model import LiveModel
    from nsf.live.player import Player

    pipeline, _ = made
    model = LiveModel(pipeline.deployment, points=50, device="cpu")
    assert [p.name for p in model.parameters] == ["friction_angle", "E"]
    player = Player(model)
    player.steer([30.0, 2000.0])
    assert player.case == pipeline.scene.case([30.0, 2000.0])
    with pytest.raises(ConfigError, match="1 values must be 2"):
        player.steer([30.0])
    run = model.start(pipeline.scene.case([60.0, 2000.0]))
    run.advance(1)
    assert run.verdict(1).beyond


def test_lessons_fill_the_box_of_training(pipeline_at, tmp_path):
    pipeline = pipeline_at(tmp_path, *TWO, "model=recurrence")
    known, between, back = pipeline.lessons
    assert known == sorted(pipeline.split.train)
    low, high = pipeline.split.box.T
    for case in (*between, *back):
        assert ((low <= case.numbers) & (case.numbers <= high)).all()


def test_too_few_training_cases_are_refused(pipeline_at, tmp_path):
    few = (*TWO[:2], "scene.design={_target_:nsf.scenes.Sobol,train:2,validation:0,test:2}")
    with pytest.raises(ConfigError, match="2 training cases, and friction_angle, E need at least 3; add"):
        pipeline_at(tmp_path, *few)


FORCED = (
    "+scene.program=0",
    "+scene.forcing.gravity.tilt={_target_: nsf.scenes.RandomTilt, angle: 20}",
    "scene.design.train=[22,26,30,34,38]",
    "scene.design.test=[[27, 2000], [33, 2001]]",
)


@pytest.mark.slow
def test_programs_through_the_whole_chain(pipeline_at, tmp_path):
    """Simulated, trained on, taught from, evaluated; a program beyond the range is distrusted."""
    taught = ("model=recurrence", "model.descents=30", "model.runs=3", "model.stress=4", "model.width=16")
    taught += ("scene.design.validation=[[24, 1000]]",)
    pipeline = pipeline_at(tmp_path, *FORCED, *taught)
    for stage in ("simulate", "train", "teach", "deploy", "evaluate"):
        pipeline.run(stage)
    assert pipeline.manifold().parameter_names == ("friction_angle",)
    case = pipeline.split.test[0]
    with Trajectory.open(pipeline.simulation(case).path / "trajectory.h5") as trajectory:
        acting = pipeline.scene.at(case).acting_gravity
        np.testing.assert_allclose(trajectory.forcing["gravity"], acting.at(trajectory.t), atol=1e-12)
        assert list(trajectory.parameters) == ["friction_angle"]
    _, drawn, validation = pipeline.lessons
    assert validation == sorted(pipeline.split.validation)
    programs = [case["program"] for case in (*pipeline.split.cases, *drawn)]
    assert len(set(programs)) == len(programs)
    steep = pipeline_at(tmp_path, *FORCED, "deploy.changes={scene.forcing.gravity.tilt.angle:60}")
    for stage in ("simulate", "deploy"):
        steep.run(stage)
    for index in range(len(steep.held_out)):
        rollout = Rollout.open(steep.deployment.file(rollout_file(index)))
        assert (rollout.verdict.flag, rollout.verdict.beyond) == ("red", True)
