"""Models by name, from the configuration to the errors of their runs on the tiny chain."""

import re
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from angles import angle

import nsf.models
from nsf import config
from nsf.data import Trajectory
from nsf.deployment import Rollout
from nsf.errors import ConfigError
from nsf.models import describe
from nsf.models.auto import Auto, Measured
from nsf.pipeline import Pipeline

HOWTO = (Path(__file__).parents[2] / "docs/howto/model.md").read_text(encoding="utf-8")


def run_of(pipeline_at, root, *overrides):
    """A pipeline that was taken to its evaluation, its rows, and what it said."""
    said = []
    untimed = ("evaluation.trials=0", "evaluation.coarse=[]")
    pipeline = pipeline_at(root, *untimed, *overrides, say=said.append)
    for stage in ("simulate", "train", "deploy", "evaluate"):
        pipeline.run(stage)
    return pipeline, pd.read_csv(pipeline.evaluation.path / "results.csv"), said


def test_interpolated_latents_are_a_model(copied, pipeline_at):
    pipeline, rows, _ = run_of(pipeline_at, copied("simulate", "train"), "model=interpolate")
    (row,) = rows.to_dict("records")
    assert (row["model"], row["fallback_share"]) == ("interpolate", 0.0)
    assert row["displacement_error"] == pytest.approx(row["displacement_interpolated"], rel=1e-9)
    kept = Rollout.open(pipeline.deployment.file("rollout_0.h5"))
    assert set(kept.stops) == {"latent"}
    again = Pipeline.of_run(pipeline.deployment, say=lambda line: None)
    solver = again.solver_at(again.manifold(), angle(26.0))
    solver.step(solver.total_steps)
    np.testing.assert_array_equal(solver.trajectory().xhat, kept.xhat)


def test_beyond_its_training_an_interpolated_run_may_be_projected(copied, pipeline_at):
    root, keys = copied("simulate", "train"), ("model=interpolate", "scene.design.test=[60]")
    pipeline, _, said = run_of(pipeline_at, root, *keys, "fallback=projected")
    kept = Rollout.open(pipeline.deployment.file("rollout_0.h5"))
    assert (kept.by, kept.verdict.flag, "latent" in kept.stops) == ("projected", "red", False)
    assert any("goes to projected, since interpolate is red: friction_angle=60 is outside" in s for s in said)
    handed, rows, _ = run_of(pipeline_at, root, *keys, "fallback=full")
    assert Rollout.open(handed.deployment.file("rollout_0.h5")).by == "full"
    assert rows["delta"][0] < 1e-6


def test_the_full_order_run_is_a_model(copied, pipeline_at):
    pipeline, rows, _ = run_of(pipeline_at, copied("simulate", "train"), "model=full")
    (row,) = rows.to_dict("records")
    assert (row["model"], row["delta"], row["fallback_share"]) == ("full", 0.0, 1.0)
    files = pipeline.deployment.file("continuation_0.h5"), pipeline.truth(angle(26.0)).file("trajectory.h5")
    with Trajectory.open(files[0]) as own, Trajectory.open(files[1]) as truth:
        np.testing.assert_array_equal(own.read("x"), truth.read("x"))


def test_auto_takes_the_cheapest_that_is_near_enough(copied, pipeline_at):
    root, validated = copied("simulate", "train"), "scene.design.validation=[24]"
    keys = ("model=auto", validated, "model.candidates=[projected,interpolate]")
    pipeline, rows, said = run_of(pipeline_at, root, *keys, "model.slack=1e6")
    assert rows["model"].tolist() == ["interpolate"]
    kept = pipeline.deployment.manifest["metrics"]
    assert [one["model"] for one in kept["candidates"]] == ["projected", "interpolate"]
    assert all(one["error"] > 0 and one["seconds"] > 0 for one in kept["candidates"])
    assert any(line.startswith("deploy: model=auto takes interpolate, the cheapest within") for line in said)
    best = min(kept["candidates"], key=lambda one: one["error"])["model"]
    _, rows, _ = run_of(pipeline_at, root, *keys, "model.slack=1.0")
    assert rows["model"].tolist() == [best]
    again = Pipeline.of_run(pipeline.deployment, say=lambda line: None)
    assert again.deployment == pipeline.deployment
    assert again.model.name == "interpolate"


def test_auto_takes_projected_without_validation_cases(copied, pipeline_at):
    _, rows, said = run_of(pipeline_at, copied("simulate", "train"), "model=auto")
    assert rows["model"].tolist() == ["projected"]
    assert any("no validation cases" in line for line in said)


def test_the_choice_of_auto():
    auto = Auto("auto", slack=1.25)
    measured = [Measured("a", 0.10, 3.0), Measured("b", 0.12, 1.0), Measured("c", 0.13, 0.1)]
    assert auto.choose([*measured, Measured("d", refused="it knows no forcing")]) == "b"
    assert auto.choose([Measured("a", np.inf, 1.0), Measured("b", 0.1, 9.0)]) == "b"
    with pytest.raises(ConfigError, match="no candidate that can run: a: it knows no forcing"):
        auto.choose([Measured("a", refused="it knows no forcing")])


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (
            ("fallback=projected",),
            "fallback=projected goes on for another model.*; set fallback=full, or none",
        ),
        (("model=full", "fallback=full"), "fallback=full has no use with model=full; set fallback=none"),
        (("model=interpolate", "deploy.dt_multiplier=1.5"), "set it to 1, or model=projected"),
        (("model=interpolate", "deploy.changes={scene.friction:0.2}"), "set model=projected"),
        (
            ("model=interpolate", "scene=block"),
            "knows no forcing.*; set model=projected, or model=recurrence",
        ),
        (("model=auto", "model.slack=0.5"), "slack=0.5 must be at least 1"),
        (("fallback=report",), "fallback=report is unknown; choose none, projected or full"),
        (("stress=particles",), "particles carry both"),
    ],
)
def test_what_cannot_be_asked_for(tmp_path, tiny, overrides, message):
    base = [] if "scene=block" in overrides else tiny
    with pytest.raises(ConfigError, match=message):
        Pipeline(config.load([*base, *overrides]), root=tmp_path).check()


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("engine=operators", "engine=operators was removed; choose model=recurrence"),
        ("engine.teaching.width=8", "engine.teaching was removed; set model.runs"),
        (
            "method=deformation_only",
            "method=deformation_only was removed; set stress=deformation",
        ),
        ("deploy.on_distrust=report", "deploy.on_distrust was removed; set fallback"),
    ],
)
def test_keys_of_before_name_those_of_now(override, message):
    with pytest.raises(ConfigError, match=message):
        config.load([override])


def test_a_model_is_described(tiny):
    described = describe(config.resolve(config.load([*tiny, "model=recurrence", "affine=none"])))
    assert described == {"model": "recurrence", "stress": "field", "affine": "none", "field": "basis"}
    assert describe(config.resolve(config.load([*tiny, "model=auto"])), "full")["model"] == "full"


@pytest.fixture
def own_model(tmp_path, monkeypatch):
    """The model of docs/howto/model.md, in one file of Python and one yaml."""
    monkeypatch.setattr(nsf.models, "__path__", [*nsf.models.__path__, str(tmp_path)])
    monkeypatch.setenv("NSF_CONFIG", str(tmp_path / "conf"))
    (tmp_path / "conf/model").mkdir(parents=True)
    for path, text in re.findall(r"```\w+ title=\"(?:nsf/models/)?(\S+)\"\n(.*?)```", HOWTO, re.DOTALL):
        (tmp_path / path).write_text(text)
    yield "polynomial"
    sys.modules.pop("nsf.models.polynomial", None)


def test_a_model_of_ones_own_is_run_and_chosen(own_model, copied, pipeline_at):
    root = copied("simulate", "train")
    _, rows, _ = run_of(pipeline_at, root, f"model={own_model}")
    assert rows["model"].tolist() == [own_model]
    assert rows["displacement_error"][0] < 0.5
    keys = ("model=auto", "scene.design.validation=[24]", f"model.candidates=[{own_model},projected]")
    chosen, _, _ = run_of(pipeline_at, root, *keys, "+model.of.polynomial.degree=1", "model.slack=1e6")
    candidates = chosen.deployment.manifest["metrics"]["candidates"]
    assert {one["model"] for one in candidates} == {own_model, "projected"}


def test_models_that_learn_share_encoded_runs(copied, pipeline_at):
    root, runs = copied("simulate", "train"), []
    for keys in (("model=dmdc",), ("model=gru", "model.descents=200", "model.width=16")):
        pipeline, rows, said = run_of(pipeline_at, root, *keys, "model.runs=8", "model.stride=2")
        name = pipeline.model.name
        assert rows["model"].tolist() == [name]
        assert rows["displacement_error"][0] < 0.3
        assert any(line.startswith(f"teach: model={name}, 11 full-order runs, 8 drawn") for line in said)
        metrics = pipeline.taught.manifest["metrics"]
        assert metrics["teach_seconds"] == metrics["stream_seconds"] + metrics["fit_seconds"]
        runs.append(pipeline.encoding)
    assert runs[0] == runs[1]
    assert sum(line.startswith("encode: inputs unchanged") for line in said) == 1
    with pytest.raises(ConfigError, match=r"model=dmdc takes strides .* set it to 1, and model.stride"):
        pipeline_at(root, "model=dmdc", "deploy.dt_multiplier=1.5")
    with pytest.raises(ConfigError, match=r"model\.delays=0 must be a whole number of at least 1"):
        pipeline_at(root, "model=dmdc", "model.delays=[0]")
