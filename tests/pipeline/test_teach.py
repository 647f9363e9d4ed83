"""Operators from their teaching to their errors, on the tiny chain; and what they are refused for."""

import re
import shutil

import numpy as np
import pandas as pd
import pytest
import torch

from nsf.deployment import Rollout, rollout
from nsf.dynamics import Method, Taylor
from nsf.engines import Operators
from nsf.engines.operators import Course
from nsf.errors import ConfigError, MissingRunError
from nsf.sampling import SampleSpan

ANGLE = {"friction_angle": 26.0}
TAUGHT = (
    "engine=operators",
    "engine.teaching.steps=400",
    "engine.teaching.descent=300",
    "engine.teaching.rounds=1",
    "engine.teaching.width=32",
)


@pytest.fixture(scope="module")
def lesson(chain, pipeline_at, tmp_path_factory):
    """The tiny chain by operators, and what it said."""
    root, said = tmp_path_factory.mktemp("taught") / "runs", []
    for stage in ("simulate", "train"):
        shutil.copytree(chain.root / stage, root / stage)
    pipeline = pipeline_at(root, *TAUGHT, say=said.append)
    for stage in ("deploy", "evaluate"):
        pipeline.run(stage)
    return pipeline, said


@pytest.fixture(scope="module")
def taught(lesson):
    pipeline, _ = lesson
    return Operators.load(pipeline.taught.path / "operators.pt")


@pytest.fixture
def reduced(lesson, taught, tiny_manifold):
    """(scene, **options) → a solver by operators; with the sample that they know."""
    pipeline, _ = lesson
    manifold = pipeline.manifold()
    known = pipeline.batch_at(manifold, [26.0]).batch.shared

    def build(scene=pipeline.scene, parameters=ANGLE, sample=known.samples, manifold=manifold, **options):
        options = {"engine": taught, "device": "cpu"} | options
        return scene.reduced(manifold, parameters, sample, **options)

    return build


# -- the stage ------------------------------------------------------------------------------------------


def test_the_chain(lesson, chain):
    pipeline, said = lesson
    assert [line.split(":")[0] for line in said if "warning" not in line] == [
        "teach",
        "deploy",
        "deploy",
        "evaluate",
    ]
    run = pipeline.taught
    assert run.manifest["parents"] == [pipeline.training.id]
    assert pipeline.deployment.manifest["parents"] == [pipeline.training.id, run.id]
    found = run.manifest["metrics"]
    assert 300 < found["teacher_steps"] <= 400
    assert len(found["errors"]) == 2
    assert found["round"] == int(np.argmin(found["errors"]))
    assert found["teach_seconds"] > 0
    assert [path.name for path in run.path.glob("*.pt")] == ["operators.pt"]
    row = pd.read_csv(pipeline.evaluation.path / "results.csv").iloc[0]
    assert (row["engine"], row["integration_mean"]) == ("operators", 0)
    projected = pd.read_csv(chain.pipeline.evaluation.path / "results.csv").iloc[0]
    # Of 0.4 thousand steps of the teacher; a run that does not move is off by 1.
    assert projected["displacement_error"] < 0.03
    assert row["displacement_error"] < 0.06


def test_a_second_call_reuses_what_was_taught(lesson, pipeline_at):
    pipeline, _ = lesson
    said = []
    pipeline_at(pipeline.root, *TAUGHT, say=said.append).deploy()
    assert said == [
        f"{run.stage}: inputs unchanged, reused → {run.id}" for run in (pipeline.taught, pipeline.deployment)
    ]


def test_no_held_out_value_is_a_lesson(pipeline_at, tmp_path):
    for seed in range(20):
        pipeline = pipeline_at(tmp_path, *TAUGHT, f"seed={seed}")
        known, between, back = pipeline.lessons
        assert known == [22.0, 30.0, 38.0]
        assert (len(between), len(back)) == (3, 3)
        assert not {*between, *back} & {26.0, *known}
    taken = pipeline_at(tmp_path, *TAUGHT, f"scene.parameters.test=[{between[1]}]")
    assert taken.taught.hash != pipeline.taught.hash


def test_a_teaching_that_was_broken_off_goes_on(lesson, copied, pipeline_at, monkeypatch):
    pipeline, _ = lesson
    root = copied("simulate", "train")
    descend = Course._descend

    def broken(course, number, generator):
        if number == 1:
            raise KeyboardInterrupt
        descend(course, number, generator)

    monkeypatch.setattr(Course, "_descend", broken)
    with pytest.raises(KeyboardInterrupt):
        pipeline_at(root, *TAUGHT).teach()
    monkeypatch.setattr(Course, "_descend", descend)
    began = []
    begin = Course._begin
    monkeypatch.setattr(Course, "_begin", lambda *given: (began.append(1), begin(*given)))
    again = pipeline_at(root, *TAUGHT).teach()
    assert not began  # the first round was there
    one, other = (
        torch.load(run.path / "operators.pt", weights_only=True) for run in (pipeline.taught, again)
    )
    assert one["taught"] == other["taught"]
    assert all(torch.equal(one["state"][name], other["state"][name]) for name in one["state"])
    metrics = [run.manifest["metrics"] for run in (pipeline.taught, again)]
    assert metrics[0]["errors"] == metrics[1]["errors"]
    assert metrics[0]["teacher_steps"] == metrics[1]["teacher_steps"]


def test_an_engine_that_learns_nothing_is_not_taught(pipeline_at, tmp_path):
    with pytest.raises(ConfigError, match="engine=auto is not taught; set engine=operators"):
        pipeline_at(tmp_path).teach()
    with pytest.raises(MissingRunError, match="run `nsf train"):
        pipeline_at(tmp_path, *TAUGHT).teach()


# -- the engine -----------------------------------------------------------------------------------------


def test_a_run_is_a_solver_as_others(reduced, lesson):
    pipeline, _ = lesson
    solver, other = reduced(), reduced()
    solver.step(24)
    for n in (1, 10, 13):
        other.step(n)
    assert torch.equal(solver.record.xhat, other.record.xhat)
    assert solver.engine == "operators"
    assert solver.trajectory().stops == ["operators"] * 24
    assert (solver.left_grid(), solver.needed_outside(), solver.integration_mean) == (-1, 0, 0.0)
    projected = reduced(engine="auto")
    projected.step(24)
    one, two = (np.asarray(run.state.numpy()["x"]) for run in (solver, projected))
    moved = np.linalg.norm(two - pipeline.scene.particles().X)
    assert np.linalg.norm(one - two) < 0.06 * moved
    first = solver.record.xhat.clone()
    solver.restart()
    solver.step(24)
    assert torch.equal(solver.record.xhat, first)
    kept = Rollout.open(pipeline.deployment.path / "rollout_0.h5")
    np.testing.assert_array_equal(kept.xhat, first.numpy())


def test_a_batch_is_its_runs(reduced, lesson, taught):
    pipeline, _ = lesson
    sample = reduced().setup.samples
    parameters = [{"friction_angle": value} for value in (23.0, 26.0, 37.0)]
    manifold = pipeline.manifold()
    batch = pipeline.scene.reduced_batch(manifold, parameters, sample, engine=taught, device="cpu")
    batch.step(24)
    for run, own in zip(batch.runs, parameters, strict=True):
        alone = reduced(parameters=own)
        alone.step(24)
        assert torch.equal(alone.record.xhat, run.record.xhat)


def test_a_run_goes_on_from_where_another_engine_is(reduced):
    projected, solver = reduced(engine="auto"), reduced()
    projected.step(10)
    for name in ("now", "before"):
        getattr(solver.record, name).copy_(getattr(projected.record, name))
    solver.record.row.fill_(10)
    solver.together.resume(10)
    for run in (solver, projected):
        run.step(1)
    change = np.abs(projected.state.xhat - projected.record.before.numpy()).max()
    assert np.abs(solver.state.xhat - projected.state.xhat).max() < 0.2 * change


@pytest.mark.parametrize(
    ("changes", "inside"),
    [
        ({"scene.gravity": [0.0, 0.2, -3.7]}, True),
        ({"scene.bodies.column.velocity": [0.0, 0.0, -0.1]}, True),
        ({"scene.gravity": [0.0, 1.0, -4.0]}, False),
    ],
)
def test_gravity_and_the_initial_velocity_may_be_others(reduced, lesson, changes, inside, tiny_trust):
    pipeline, _ = lesson
    changed = pipeline.scene.with_changes(changes)
    plain, own, projected = reduced(), reduced(scene=changed), reduced(scene=changed, engine="auto")
    for run in (plain, own, projected):
        run.step(12)
    difference = np.abs(projected.state.xhat - plain.state.xhat).max()
    assert np.abs(own.state.xhat - plain.state.xhat).max() > 0.3 * difference
    assert (own.doubt[0] <= 1.0) == inside
    if not inside:
        own.restart()
        assert rollout(own, 26.0, tiny_trust).distrusted == 0


def test_a_parameter_outside_of_what_was_taught_is_doubted(reduced):
    assert reduced(parameters={"friction_angle": 38.0}).doubt == (1.0, "")
    off, text = reduced(parameters={"friction_angle": 42.0}).doubt
    assert off == pytest.approx(1.5)
    assert text == "friction_angle=42 is outside of 22 … 38"


def test_what_operators_were_not_taught_on_is_refused(reduced, lesson, tiny_manifold):
    pipeline, _ = lesson
    other = pipeline.manifold()
    other.training_latents[0] += 1e-6
    refused = [
        ({"manifold": other}, "another manifold"),
        ({"sample": 21}, "another sample"),
        ({"dt_multiplier": 1.5}, "another Δt"),
        ({"method": Method("deformation_only", False, False)}, "another method"),
        ({"projector": Taylor()}, "another projector"),
        ({"scene": pipeline.scene.with_changes({"material.nu": 0.25})}, "another scene"),
    ]
    for options, message in refused:
        with pytest.raises(ConfigError, match=re.escape(f"they were taught on {message}")):
            reduced(**options)
    spans = [SampleSpan(0.0, reduced().samples[0].particles), SampleSpan(0.5, np.arange(20))]
    with pytest.raises(ConfigError, match="another sample"):
        reduced(sample=spans)


def test_a_name_is_not_enough(chain, tiny_manifold):
    with pytest.raises(ConfigError, match=re.escape("give engine=nsf.engines.Operators.load(FILE)")):
        chain.scene.reduced(tiny_manifold, ANGLE, 20, engine="operators", device="cpu")
