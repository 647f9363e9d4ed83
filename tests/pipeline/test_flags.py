"""Models that are wrong on purpose are red or amber, and the bound of a good one holds."""

import shutil

import pandas as pd
import pytest

from nsf.deployment import TRUST, Trust

VALIDATED = ("scene.design.validation=[24,34]", "scene.design.test=[26,36]")
UNTIMED = ("evaluation.trials=0", "evaluation.coarse=[]")
STAGES = ("simulate", "train", "teach", "deploy")
QUICK = ("model=recurrence", "model.runs=4", "model.descents=2", "model.width=8", "model.members=2")


@pytest.fixture(scope="module")
def root(chain, tmp_path_factory):
    root = tmp_path_factory.mktemp("trust") / "runs"
    for stage in ("simulate", "train"):
        shutil.copytree(chain.root / stage, root / stage)
    return root


@pytest.fixture
def deployed(pipeline_at, root):
    """Overrides → the pipeline with its runs, and what it said."""

    def run(*overrides):
        said = []
        pipeline = pipeline_at(root, *UNTIMED, *VALIDATED, *overrides, say=said.append)
        for stage in STAGES:
            if stage in pipeline.stages:
                pipeline.run(stage)
        return pipeline, said

    return run


@pytest.fixture
def rows(deployed):
    """Overrides → the pipeline, its rows and what it said."""

    def run(*overrides):
        pipeline, said = deployed(*overrides)
        return pipeline, pd.read_csv(pipeline.evaluate().file("results.csv")), said

    return run


@pytest.mark.parametrize("model", ["projected", "interpolate"])
def test_a_good_model_is_green_and_its_bound_holds(rows, model):
    pipeline, table, said = rows(f"model={model}")
    assert table["flag"].tolist() == ["green", "green"]
    assert (table["error_bound"] >= table["displacement_error"]).all()
    assert (table["error_bound"] <= 5.0 * table["displacement_error"]).all()
    assert sum("2 validation runs set the error bounds" in line for line in said) == 1
    assert pipeline.validating.deployment.id in pipeline.deployment.parents
    trust = Trust.open(pipeline.deployment.file(TRUST), pipeline.manifold())
    assert trust.calibration.errors.shape == (2,)


def test_validation_runs_are_made_once(deployed):
    deployed("model=interpolate")
    _, said = deployed("model=interpolate", "scene.design.test=[27]")
    assert any("deploy: inputs unchanged, reused" in line for line in said)


@pytest.mark.parametrize(
    "wrong",
    [
        ("stress=deformation", "affine=none"),
        ("latent_dim=1", "sampler.size=5"),
        ("scene.design.train=[37,38]",),
        ("deploy.changes={scene.gravity:[0,0,-14]}",),
        QUICK,
    ],
    ids=["baseline", "one coordinate", "two training runs", "gravity", "untrained"],
)
def test_what_is_wrong_on_purpose_is_red_or_amber(deployed, wrong):
    pipeline, _ = deployed(*wrong)
    flags = pipeline.deployment.manifest["metrics"]["flags"]
    assert flags["red"] + flags["amber"] == sum(flags.values()) == 2


def test_one_validation_run_gives_a_coarse_bound(rows):
    _, table, _ = rows("model=interpolate", "scene.design.validation=[30.5]")
    assert table["flag_reason"].tolist() == ["the bound is coarse, of one validation run"] * 2
    assert (table["error_bound"] >= table["displacement_error"]).all()


def test_validation_cases_in_a_corner(rows):
    """The bound is wider the further away a case is, and holds in the other corner."""
    _, table, _ = rows("scene.design.validation=[22.5,23.5]", "scene.design.test=[25,37]")
    assert (table["error_bound"] >= table["displacement_error"]).all()
    assert table["error_bound"][1] > table["error_bound"][0]


def test_cases_are_drawn_from_the_whole_range(deployed):
    """Training cases do not reach its ends; a case that is drawn there is none beyond."""
    drawn = "scene.design={_target_:nsf.scenes.Sobol,train:4,validation:2,test:2}"
    pipeline, _ = deployed("+scene.parameters.friction_angle.range=[22,38]", drawn, "model=interpolate")
    trust = Trust.open(pipeline.deployment.file(TRUST), pipeline.manifold())
    assert trust.reach.box.tolist() == [[22.0, 38.0]]
    assert pipeline.split.box.tolist() != [[22.0, 38.0]]


def test_a_parameter_may_turn_gravity(rows):
    """Gravity of training is that of the training cases, not that of the scene without a case."""
    turned = ("+scene.inclination={_target_:nsf.scenes.Inclination,angle:0}", "model=interpolate")
    angle = (
        "~scene.parameters.friction_angle",
        "+scene.parameters.angle={key:scene.inclination.angle,unit:deg}",
    )
    design = ("scene.design.train=[0,5,10]", "scene.design.validation=[3,8]", "scene.design.test=[4,14]")
    _, table, _ = rows(*turned, *angle, *design)
    assert table["beyond"].tolist() == [0, 1]
    assert table["flag"][0] != "red"


def test_a_red_run_is_taken_whole_by_the_fallback(rows):
    _, table, said = rows(*QUICK, "fallback=projected")
    assert table["fallback_share"].tolist() == [1.0, 1.0]
    assert table["flag"].tolist() == ["green", "green"]  # those of the projected runs
    assert any("goes to projected, since recurrence is red" in line for line in said)
