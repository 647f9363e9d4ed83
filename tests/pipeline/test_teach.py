"""Operators from their teaching to their errors, on the tiny chain; and what they are refused for."""

import json
import re
import shutil

import numpy as np
import pandas as pd
import pytest
import torch
from angles import angle, rollout

import nsf
from nsf.data import Trajectory
from nsf.deployment import OPERATORS, PROJECTED, Fallback, Rollout, rollouts
from nsf.deployment.estimate import estimated_errors
from nsf.dynamics import Sources, Taylor
from nsf.engines import Operators
from nsf.engines.operators import Course, Teacher
from nsf.errors import ConfigError, MissingRunError
from nsf.evaluation import compare
from nsf.pipeline.stages import teaching
from nsf.sampling import RandomSampler, SampleSpan

ANGLE = {"friction_angle": 26.0}
TAUGHT = (
    "model=recurrence",
    "model.teaching.steps=400",
    "model.teaching.descent=300",
    "model.teaching.rounds=1",
    "model.teaching.width=32",
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


def test_the_sample_is_kept_with_the_operators(lesson, pipeline_at, monkeypatch):
    """A sampler that learns from steps on a GPU may choose otherwise each time it is asked."""
    pipeline, _ = lesson
    again = pipeline_at(pipeline.root, *TAUGHT)
    monkeypatch.setattr(
        RandomSampler, "choose", lambda self, manifold, candidates, size, device: candidates[:size]
    )
    manifold = again.manifold()
    for engine in (None, "modal"):
        batch = again.batch_at(manifold, [angle(26.0)], engine=engine)
        known = pipeline.batch_at(manifold, [angle(26.0)]).batch.shared.samples
        for one, other in zip(batch.batch.shared.samples, known, strict=True):
            np.testing.assert_array_equal(one.particles, other.particles)


@pytest.fixture
def reduced(lesson, taught, tiny_manifold):
    """(scene, **options) → a solver by operators; with the sample that they know."""
    pipeline, _ = lesson
    manifold = pipeline.manifold()
    known = pipeline.batch_at(manifold, [angle(26.0)]).batch.shared

    def build(scene=pipeline.scene, parameters=ANGLE, sample=known.samples, manifold=manifold, **options):
        options = {"engine": taught, "device": "cpu"} | options
        return nsf.reduced(scene, manifold, parameters, sample, **options)

    return build


# -- the stage ------------------------------------------------------------------------------------------


def test_the_chain(lesson, chain):
    pipeline, said = lesson
    assert [line.split(":")[0] for line in said if "warning" not in line] == [
        "teach",
        "deploy",
        "evaluate",
    ]
    run = pipeline.taught
    assert run.manifest["parents"] == [pipeline.training.id]
    assert pipeline.deployment.manifest["parents"] == [pipeline.training.id, run.id]
    found = run.manifest["metrics"]
    # 400 are asked for, and each of three runs is asked at 40 moments at least, in each of two rounds.
    assert 300 < found["teacher_steps"] <= 700
    assert len(found["errors"]) == 2
    assert found["round"] == int(np.argmin(found["errors"]))
    assert found["teach_seconds"] > 0
    assert [path.name for path in run.path.glob("*.pt")] == ["operators.pt"]
    row = pd.read_csv(pipeline.evaluation.path / "results.csv").iloc[0]
    assert (row["model"], row["integration"]) == ("recurrence", 0)
    projected = pd.read_csv(chain.pipeline.evaluation.path / "results.csv").iloc[0]
    # Of 0.4 thousand steps of the teacher; a run that does not move is off by 1.
    assert projected["displacement_error"] < 0.03
    assert row["displacement_error"] < 0.06


def test_a_second_call_reuses_what_was_taught(lesson, pipeline_at):
    pipeline, _ = lesson
    said = []
    pipeline_at(pipeline.root, *TAUGHT, say=said.append).deploy()
    assert said == [f"deploy: inputs unchanged, reused → {pipeline.deployment.id}"]


@pytest.mark.slow
def test_no_held_out_value_is_a_lesson(pipeline_at, tmp_path):
    for seed in range(20):
        pipeline = pipeline_at(tmp_path, *TAUGHT, f"seed={seed}")
        known, between, back = pipeline.lessons
        assert known == list(map(angle, (22.0, 30.0, 38.0)))
        assert (len(between), len(back)) == (3, 3)
        assert not {*between, *back} & {angle(26.0), *known}
    taken = pipeline_at(tmp_path, *TAUGHT, f"scene.design.test={list(between[1].numbers)}")
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


@pytest.fixture
def of_runs(copied, pipeline_at):
    """A chain whose operators learn from full-order runs, as far as training."""
    keys = (*TAUGHT, "model.teacher=runs", "model.teaching.unroll=16", "model.teaching.descent=600")
    return pipeline_at(copied("simulate", "train"), *keys)


@pytest.mark.slow
def test_full_order_runs_teach_without_a_step_of_an_engine(of_runs, monkeypatch):
    monkeypatch.setattr("nsf.engines.operators.Teacher.step_from", None)
    said = []
    monkeypatch.setattr(of_runs, "say", said.append)
    for stage in ("deploy", "evaluate"):
        of_runs.run(stage)
    assert any("% off in the training cases, as there are no validation cases" in line for line in said)
    found = of_runs.taught.manifest["metrics"]
    assert found["teacher_steps"] == 0
    assert found["broken_affinity"] is None
    assert len(found["errors"]) == 1
    row = pd.read_csv(of_runs.evaluation.path / "results.csv").iloc[0]
    assert row["displacement_error"] < 0.06  # a run that does not move is off by 1
    assert Operators.load(of_runs.taught.path / "operators.pt").taught.reach == 0.0  # one gravity was seen


def test_what_full_order_runs_taught_is_held_to_those_of_validation(of_runs, pipeline_at, tmp_path):
    known, between, back = of_runs.lessons
    assert (known, between, back) == (list(map(angle, (22.0, 30.0, 38.0))), [], known)
    held_back = pipeline_at(tmp_path, *TAUGHT, "model.teacher=runs", "scene.design.validation=[24]")
    assert held_back.lessons[2] == [angle(24.0)]


@pytest.fixture
def drawn(copied, pipeline_at):
    """(say, keys) → the same chain with stress that particles carry, and three projected runs as lessons."""
    root = copied("simulate", "train")

    def build(say=lambda line: None, *more):
        keys = ("model.teacher=runs", "model.teaching.unroll=16", "model.teaching.descent=600")
        keys += (
            "model.teaching.runs=3",
            "stress=particles",
            "affine=particles",
            "model.error_ratio=null",
            *more,
        )
        return pipeline_at(root, *TAUGHT, *keys, say=say)

    return build


@pytest.mark.slow
def test_projected_runs_in_drawn_cases_teach_too(drawn, monkeypatch):
    pipeline = drawn()
    known, between, _ = pipeline.lessons
    assert len(between) == 3
    assert not {*between} & {angle(26.0), *known}
    for stage in ("deploy", "evaluate"):
        pipeline.run(stage)
    assert pipeline.taught.manifest["metrics"]["teacher_steps"] == 3 * pipeline.scene.steps
    row = pd.read_csv(pipeline.evaluation.path / "results.csv").iloc[0]
    assert row["displacement_error"] < 0.06
    assert row["stress"] == row["affine"] == "particles"
    monkeypatch.setattr("nsf.deployment.fallback.first_distrusted", lambda ratios: 11)
    doubted = drawn(lambda line: None, "fallback=projected")  # taken anew by projected steps
    for stage in ("deploy", "evaluate"):
        doubted.run(stage)
    anew = pd.read_csv(doubted.evaluation.path / "results.csv").iloc[0]
    assert anew["fallback_share"] == 1.0
    assert np.isnan(anew["estimated_error"])  # of a run that the recurrence took no step of
    taken = Rollout.open(doubted.deployment.path / "rollout_0.h5")
    with Trajectory.open(doubted.truth(angle(26.0)).file("trajectory.h5")) as truth:
        projected = doubted.solver_at(doubted.manifold(), angle(26.0), engine="auto")
        carried = compare(projected, truth, taken, "test", (50, 4)).stress_error
        fields = doubted.solver_at(doubted.manifold(), angle(26.0))
        assert carried != pytest.approx(compare(fields, truth, taken, "test", (50, 4)).stress_error)
    assert anew["stress_error"] == pytest.approx(carried)


@pytest.mark.slow
@pytest.mark.parametrize("sources", [("particles", "particles"), ("field", "field")])
def test_operators_too_far_off_at_validation_runs_take_no_step(drawn, sources):
    said = []
    held_back = f"stress={sources[0]}", f"affine={sources[1]}", "scene.design.validation=[24]"
    first = drawn(said.append, *held_back)
    for stage in ("simulate", "teach"):
        first.run(stage)
    told, manifold = first.taught.manifest["metrics"], first.manifold()
    projected = first.solver_at(manifold, angle(24.0), engine="auto")
    projected.step(24)
    with Trajectory.open(first.simulation(angle(24.0)).file("trajectory.h5")) as trajectory:
        truth = torch.as_tensor(trajectory.read("x")).double()
    off = (manifold.restrict().position(projected.record.xhat) - truth).square().sum().sqrt()
    off = float(off / (truth - truth[0]).square().sum().sqrt())
    assert told["projected_error"] == pytest.approx(off, rel=1e-6)
    ratio = told["errors"][0] / off
    for error_ratio, by_operators in ((0.99 * ratio, 0), (1.01 * ratio, 24)):
        said.clear()
        pipeline = drawn(said.append, *held_back, f"model.error_ratio={error_ratio}")
        pipeline.run("deploy")
        taken = Rollout.open(pipeline.deployment.path / "rollout_0.h5")
        assert taken.by_operators == by_operators
        assert any("so that the projected step takes all runs" in line for line in said) == (
            by_operators == 0
        )
        if by_operators == 0:
            alone = pipeline.solver_at(manifold, angle(26.0), engine="auto")
            alone.step(24)
            np.testing.assert_array_equal(taken.xhat, alone.record.xhat.numpy())
            assert (taken.estimate.max(), taken.projected_share) == (0.0, 1.0)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("held_back", "lost", "ratio"),
    [("[24]", True, "1e-3"), ("[24]", False, "null"), ("[]", False, "1e-3")],
    ids=["a lost validation run", "no ratio", "no validation run"],
)
def test_operators_keep_their_runs_where_nothing_tells_that_they_are_off(
    drawn, monkeypatch, held_back, lost, ratio
):
    keys = f"scene.design.validation={held_back}", f"model.error_ratio={ratio}"
    pipeline = drawn(lambda line: None, *keys)
    monkeypatch.setattr(Teacher, "left_grid", lambda teacher: [lost] * len(teacher))
    monkeypatch.setattr(teaching, "drawn", lambda *args: [])
    for stage in ("simulate", "deploy"):
        pipeline.run(stage)
    assert (pipeline.taught.manifest["metrics"]["projected_error"] is None) == lost
    assert Rollout.open(pipeline.deployment.path / "rollout_0.h5").by_operators == 24


def test_drawn_runs_stand_beside_full_order_ones(pipeline_at, tmp_path):
    with pytest.raises(ConfigError, match=r"runs=3 stand beside full-order runs; set model\.teacher=runs"):
        pipeline_at(tmp_path, *TAUGHT, "model.teaching.runs=3")
    with pytest.raises(ConfigError, match="runs=-1 must be at least 0"):
        pipeline_at(tmp_path, *TAUGHT, "model.teacher=runs", "model.teaching.runs=-1")


def test_projected_runs_that_are_lost_teach_nothing(drawn, monkeypatch):
    said = []
    pipeline, run = drawn(said.append), Teacher.run

    def lost(teacher):
        found = run(teacher)
        if len(teacher) == 3:
            found[7:, 1] = torch.nan
        return found

    monkeypatch.setattr(Teacher, "run", lost)
    lessons = teaching.drawn(pipeline, pipeline.manifold(), lambda steps: None)
    assert [len(teacher) for teacher in lessons] == [2]
    assert said == ["teach: warning: 1 of 3 projected runs are lost"]
    assert bool(torch.isfinite(lessons[0].run()).all())
    monkeypatch.setattr(Teacher, "run", lambda teacher: torch.full_like(run(teacher), torch.nan))
    assert teaching.drawn(pipeline, pipeline.manifold(), lambda steps: None) == []


@pytest.mark.slow
def test_projected_runs_in_drawn_cases_are_the_same_by_several_processes(drawn, monkeypatch):
    pipeline, told = drawn(), []
    alone = teaching.drawn(pipeline, pipeline.manifold(), lambda steps: None)
    monkeypatch.setattr(teaching, "_LEAST_RUNS", 1)
    monkeypatch.setattr(teaching, "cpu_count", lambda: 2)
    monkeypatch.setattr(Teacher, "run", None)  # of this process, which takes none
    (beside,) = teaching.drawn(pipeline, pipeline.manifold(), told.append)
    np.testing.assert_array_equal(beside.run(), alone[0].run())
    assert (beside.steps, alone[0].steps, told) == (72, 72, [24, 24, 24])


def test_full_order_runs_teach_their_own_step_alone(pipeline_at, tmp_path):
    with pytest.raises(ConfigError, match=r"the scene's Δt.*dt_multiplier is 1.5; set it to 1"):
        pipeline_at(tmp_path, *TAUGHT, "model.teacher=runs", "deploy.dt_multiplier=1.5")


def test_an_engine_that_learns_nothing_is_not_taught(pipeline_at, tmp_path):
    with pytest.raises(ConfigError, match="model=projected is not taught; set model=recurrence"):
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
    assert solver.engine == "recurrence"
    assert solver.trajectory().stops == ["recurrence"] * 24
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
    batch = nsf.reduced_batch(pipeline.scene, manifold, parameters, sample, engine=taught, device="cpu")
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
    changed = pipeline.scene.changed(changes)
    plain, own, projected = reduced(), reduced(scene=changed), reduced(scene=changed, engine="auto")
    for run in (plain, own, projected):
        run.step(12)
    difference = np.abs(projected.state.xhat - plain.state.xhat).max()
    assert np.abs(own.state.xhat - plain.state.xhat).max() > 0.3 * difference
    assert (own.doubt[0] <= 1.0) == inside
    if not inside:
        own.restart()
        assert rollout(own, angle(26.0), tiny_trust).distrusted == 0


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
        ({"sources": Sources("deformation", "none")}, "another sources"),
        ({"projector": Taylor()}, "another projector"),
        ({"scene": pipeline.scene.changed({"material.nu": 0.25})}, "another scene"),
    ]
    for options, message in refused:
        with pytest.raises(ConfigError, match=re.escape(f"they were taught on {message}")):
            reduced(**options)
    spans = [SampleSpan(0.0, reduced().samples[0].particles), SampleSpan(0.5, np.arange(20))]
    with pytest.raises(ConfigError, match="another sample"):
        reduced(sample=spans)


def test_a_name_is_not_enough(chain, tiny_manifold):
    with pytest.raises(ConfigError, match=re.escape("give nsf.engines.Operators.load(FILE)")):
        nsf.reduced(chain.scene, tiny_manifold, ANGLE, 20, engine="operators", device="cpu")


# -- fallback -------------------------------------------------------------------------------------------


@pytest.fixture
def fallback_of(lesson):
    pipeline, _ = lesson
    manifold = pipeline.manifold()

    def build(to="none"):
        return Fallback(to, lambda cases: pipeline.batch_at(manifold, cases, engine="auto"), 4)

    return build


def test_the_estimate_is_how_far_projected_runs_are(reduced, lesson, fallback_of):
    pipeline, _ = lesson
    cases = [angle(23.0), angle(26.0)]
    batch = pipeline.batch_at(pipeline.manifold(), cases)
    batch.step(24)
    projected = fallback_of().projected(cases)
    found = estimated_errors(batch, projected, 1)
    projected.restart()
    projected.step(24)
    at = batch.span.at_sample
    for run, other, estimate in zip(batch.runs, projected.runs, found, strict=True):
        off = at.position(run.record.xhat) - at.position(other.record.xhat)
        error = off.square().sum(-1).mean(-1).sqrt().numpy()
        assert error[-1] > 1e-5
        # Of operators that were hardly taught, which carry a defect on as badly as they step.
        assert 0.3 * error.max() < estimate.max() < 5.0 * error.max()
    assert (batch.batch.record.residuals[:, 1:, -1] > 0).all()


def test_where_it_is_not_believed_the_projected_step_goes_on(reduced, fallback_of, tiny_trust, monkeypatch):
    own = rollouts(reduced().together, [angle(26.0)], tiny_trust, fallback_of())[0]
    assert (own.by_operators, own.levels.tolist()) == (24, [OPERATORS] * 24)
    assert own.estimate[0] == 0.0 < own.estimate[-1]
    n = 10
    monkeypatch.setattr("nsf.deployment.fallback.first_distrusted", lambda ratios: n + 1)
    found = rollouts(reduced().together, [angle(26.0)], tiny_trust, fallback_of("projected"))[0]
    assert found.levels.tolist() == [OPERATORS] * n + [PROJECTED] * (24 - n)
    assert [stop == "latent" for stop in found.stops] == (found.levels == OPERATORS).tolist()
    np.testing.assert_array_equal(found.xhat[: n + 1], own.xhat[: n + 1])
    projected = reduced(engine="auto")
    for name, values in (("now", own.xhat[n]), ("before", own.xhat[n - 1])):
        getattr(projected.record, name).copy_(torch.as_tensor(values))
    projected.record.xhat[: n + 1] = torch.as_tensor(own.xhat[: n + 1])
    projected.record.row.fill_(n)
    projected.together.resume(n)
    projected.step(24 - n)
    np.testing.assert_allclose(found.xhat[-1], projected.state.xhat, rtol=0, atol=1e-12)


def test_what_is_doubted_is_projected_where_that_may_go_on(reduced, fallback_of, tiny_trust):
    outside = angle(60.0)
    solver = reduced(parameters=outside)
    found = rollouts(solver.together, [outside], tiny_trust, fallback_of("projected"))[0]
    assert (found.by_operators, found.levels.tolist()) == (0, [PROJECTED] * 24)
    assert reduced().doubt[0] <= 1.0
    plain = rollouts(reduced(parameters=outside).together, [outside], tiny_trust, fallback_of())[0]
    assert plain.by_operators == 24
    assert (plain.trust > 1.0).all()  # never without saying so


def test_a_rollout_keeps_who_took_its_steps(lesson, tmp_path):
    pipeline, _ = lesson
    kept = Rollout.open(pipeline.deployment.path / "rollout_0.h5")
    assert kept.by_operators == 24
    assert kept.estimate.shape == (25,)
    assert pipeline.deployment.manifest["metrics"]["by_operators"] == [24]
    row = pd.read_csv(pipeline.evaluation.path / "results.csv").iloc[0]
    assert row["fallback_share"] == 0.0
    assert row["estimated_error"] == pytest.approx(kept.estimate.max())
    assert 1e-4 < row["distance_max"] < 1e-2
    assert row["teach_seconds"] == pytest.approx(pipeline.taught.manifest["metrics"]["teach_seconds"])
    offline = row["teach_seconds"] + pipeline.training.manifest["metrics"]["training_seconds"]
    assert row["break_even_runs"] > offline / (1e-3 * 40 * row["step_ms_full"])


def test_a_run_that_is_handed_on_costs_what_its_steps_cost(lesson, pipeline_at, monkeypatch):
    pipeline, _ = lesson
    monkeypatch.setattr("nsf.deployment.fallback.first_distrusted", lambda ratios: 11)
    handed = pipeline_at(pipeline.root, *TAUGHT, "fallback=projected")
    for stage in ("deploy", "evaluate"):
        handed.run(stage)
    row = pd.read_csv(handed.evaluation.path / "results.csv").iloc[0]
    cost = json.loads((handed.evaluation.path / "cost.json").read_text())
    share = row["fallback_share"]
    assert 0.0 < share < 1.0
    for name in ("step_ms", "total_ms"):
        own, projected = (cost[solver][name] for solver in ("reduced", "projected"))
        assert row[name] == pytest.approx((1.0 - share) * own + share * projected)
    saved = 1e-3 * (row["total_ms_full"] - row["total_ms"])
    offline = row["teach_seconds"] + handed.training.manifest["metrics"]["training_seconds"]
    assert row["break_even_runs"] == (pytest.approx(offline / saved) if saved > 0.0 else np.inf)


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ((*TAUGHT, "model.error_ratio=0"), "model: error_ratio=0 must be positive, or null to leave"),
        ((*TAUGHT, "model.check=0"), "model: check=0 must be a whole number of at least 1"),
        ((*TAUGHT, "model.teacher=operators"), "model: teacher=operators is unknown"),
        ((*TAUGHT, "model.teaching.width=0"), "model.teaching: width=0 must be at least 1"),
    ],
)
def test_what_cannot_be_asked_for(pipeline_at, tmp_path, overrides, message):
    with pytest.raises(ConfigError, match=re.escape(message)):
        pipeline_at(tmp_path, *overrides)
