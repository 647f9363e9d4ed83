"""A recurrence from its teaching to its errors, on the tiny chain; and what it is refused for."""

import json
import re
import shutil

import numpy as np
import pandas as pd
import pytest
import torch
from angles import angle
from tiny import TAUGHT

import nsf
from nsf.deployment import TRUST, Rollout, Trust, rollouts
from nsf.dynamics.integration import NeighbourSearch
from nsf.errors import ConfigError, InstabilityError, MissingRunError
from nsf.pipeline import Pipeline, preview
from nsf.pipeline.durations import times
from nsf.pipeline.stages import encoding
from nsf.progress import Progress
from nsf.recurrence import RecurrenceEngine

ANGLE = {"friction_angle": 26.0}


@pytest.fixture(scope="module")
def bars():
    """Bars that have ended, each with its stage, what was done, and its total."""
    ended = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Progress, "__exit__", lambda bar, *_: ended.append((bar._stage, bar._done, bar._total)))
        yield ended


@pytest.fixture(scope="module")
def lesson(taught_root, bars, pipeline_at, tmp_path_factory):
    """The tiny chain by a recurrence, and what it said."""
    root, said = shutil.copytree(taught_root, tmp_path_factory.mktemp("taught") / "runs"), []
    pipeline = pipeline_at(root, *TAUGHT, say=said.append)
    for stage in ("deploy", "evaluate"):
        pipeline.run(stage)
    return pipeline, said


@pytest.fixture(scope="module")
def taught(lesson):
    pipeline, _ = lesson
    return RecurrenceEngine.load(pipeline.taught.path / "recurrence.pt")


@pytest.fixture
def reduced(lesson, taught):
    """(scene, **options) → a solver by the recurrence."""
    pipeline, _ = lesson
    manifold = pipeline.manifold()
    known = pipeline.batch_at(manifold, [angle(26.0)]).batch.shared

    def build(scene=pipeline.scene, parameters=ANGLE, sample=known.samples, manifold=manifold, **options):
        return nsf.reduced(
            scene, manifold, parameters, sample, **{"engine": taught, "device": "cpu"} | options
        )

    return build


# -- the stage ------------------------------------------------------------------------------------------


def test_bars_end_at_their_totals(lesson, bars):
    assert [stage for stage, *_ in bars[:3]] == ["deploy", "evaluate", "evaluate: timings"]
    assert all(done == total > 0 for _, done, total in bars)


def test_a_plan_holds_times_of_like_work(lesson, pipeline_at):
    pipeline, _ = lesson
    measured = times(pipeline.root)
    assert {work.stage for work, _ in measured} >= {"teach", "deploy", "evaluate"}
    longer = pipeline_at(pipeline.root, *TAUGHT, "model.descents=181")
    stages = {stage.name: stage for stage in preview.stages_of([longer])}
    assert [name for name, stage in stages.items() if stage.missing] == [
        "teach",
        "deploy",
        "evaluate",
        "report",
    ]
    seconds = {work.stage: seconds for work, seconds in measured}
    for name in ("teach", "deploy", "evaluate"):
        assert 0 < stages[name].time.low < seconds[name] < stages[name].time.high
        assert stages[name].time.like == "1 time"


def test_the_chain(lesson):
    pipeline, said = lesson
    assert [line.split(":")[0] for line in said if "warning" not in line] == ["deploy", "deploy", "evaluate"]
    run = pipeline.taught
    assert run.manifest["parents"] == [pipeline.training.id, pipeline.encoding.id]
    assert pipeline.deployment.manifest["parents"] == [pipeline.training.id, run.id]
    metrics = run.manifest["metrics"]
    assert (metrics["runs"], metrics["streamed"], len(metrics["errors"])) == (11, 8, 3)
    assert 0 < metrics["run_seconds"] <= metrics["stream_seconds"] < metrics["teach_seconds"]
    row = pd.read_csv(pipeline.evaluation.path / "results.csv").iloc[0]
    assert (row["model"], row["integration"]) == ("recurrence", 0)
    assert row["displacement_error"] < 0.06  # a run that does not move is off by 1


def test_a_second_call_reuses_what_was_taught(lesson, pipeline_at):
    pipeline, _ = lesson
    said = []
    pipeline_at(pipeline.root, *TAUGHT, say=said.append).deploy()
    assert said == [f"deploy: inputs unchanged, reused → {pipeline.deployment.id}"]


def test_no_held_out_value_is_a_lesson(pipeline_at, tmp_path):
    for seed in range(3):
        pipeline = pipeline_at(tmp_path, *TAUGHT, f"seed={seed}")
        known, drawn, back = pipeline.lessons
        assert known == back == list(map(angle, (22.0, 30.0, 38.0)))
        assert len(drawn) == 8
        assert not {*drawn} & {angle(26.0), *known}
    held_back = pipeline_at(tmp_path, *TAUGHT, "scene.design.validation=[24]")
    assert held_back.lessons[2] == [angle(24.0)]
    assert held_back.taught.hash != pipeline.taught.hash


def test_runs_of_a_teaching_that_was_broken_off_are_taken_up(lesson, bars, copied, pipeline_at, monkeypatch):
    pipeline, _ = lesson
    root = copied("simulate", "train")
    streamed, made = encoding.streamed, []

    def broken(*given):
        if len(made) == 5:
            raise KeyboardInterrupt
        made.append(1)
        return streamed(*given)

    monkeypatch.setattr(encoding, "streamed", broken)
    with pytest.raises(KeyboardInterrupt):
        encoded(pipeline_at(root, *TAUGHT))
    damaged, said = [next(root.rglob(f"encoded_{index}.npz")) for index in (0, 3)], []
    for path in damaged:  # of a simulation that is there, and of a streamed run
        data = bytearray(path.read_bytes())
        data[len(data) // 2] ^= 4
        path.write_bytes(data)
    made[:] = [1] * 6
    again = encoded(pipeline_at(root, *TAUGHT, say=said.append))
    assert bars[-1] == ("encode", 11 * 24, 11 * 24)
    assert len(made) == 10  # three of eight runs were left, and one was damaged
    assert all(any(str(path) in line for line in said) for path in damaged)
    same_runs(again, pipeline.encoding)


def encoded(pipeline):
    """The encode run of a pipeline, made without what is fitted to it."""
    return pipeline._made(pipeline.encoding, "encoding.encode")


def same_runs(one, other):
    """Two encode runs hold the same bits."""
    for name in (output["path"] for output in one.manifest["outputs"]):
        with np.load(one.file(name)) as a, np.load(other.file(name)) as b:
            assert all(np.array_equal(a[key], b[key]) for key in a.files if key != "seconds")


@pytest.mark.slow
def test_runs_by_several_processes_are_the_same(lesson, copied, pipeline_at, monkeypatch):
    pipeline, _ = lesson
    monkeypatch.setattr(encoding, "helper_count", lambda *of: 1)
    same_runs(encoded(pipeline_at(copied("simulate", "train"), *TAUGHT)), pipeline.encoding)


def test_runs_that_are_lost_teach_nothing(copied, pipeline_at, monkeypatch):
    streamed, made, said = encoding.streamed, [], []

    def lost(*given):
        made.append(1)
        if len(made) == 2:
            raise InstabilityError("it burst")
        return streamed(*given)

    monkeypatch.setattr(encoding, "streamed", lost)
    pipeline = pipeline_at(copied("simulate", "train"), *TAUGHT, say=said.append)
    assert encoded(pipeline).manifest["metrics"]["runs"] == 10
    assert any("warning: 1 of 11 full-order runs are lost" in line and "it burst" in line for line in said)


def test_a_model_that_learns_nothing_is_not_taught(pipeline_at, tmp_path):
    with pytest.raises(ConfigError, match="model=projected is not taught; set model=recurrence"):
        pipeline_at(tmp_path).teach()
    with pytest.raises(MissingRunError, match="run `nsf train"):
        pipeline_at(tmp_path, *TAUGHT).teach()


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        (("deploy.dt_multiplier=1.5",), "the scene's Δt, and deploy.dt_multiplier is 1.5; set it to 1"),
        (
            ("model.stride=5",),
            "model.stride=5 does not divide the 24 steps of a run; set model.stride to one of",
        ),
        (
            ("model.stress=20",),
            "model.stress=20 coordinates need as many runs, and there are 11; set model.runs=17",
        ),
        (("model.runs=-1",), "model.runs=-1 must be a whole number of at least 0"),
        (
            ("+scene.program=0", "+scene.forcing.gravity.tilt={_target_: nsf.scenes.RandomTilt, angle: 20}"),
            "chooses its weights by validation programs, and scene.design.validation is 0; set it to 4",
        ),
        (("+model.teacher=runs",), "model.teacher was removed"),
        (("+reduction.memory=[0.1]",), "reduction.memory was removed"),
    ],
)
def test_bad_keys(pipeline_at, tmp_path, keys, message):
    with pytest.raises(ConfigError, match=re.escape(message)):
        pipeline_at(tmp_path, *TAUGHT, *keys)


# -- the engine -----------------------------------------------------------------------------------------


def test_a_run_is_a_solver_as_others(reduced, lesson):
    pipeline, _ = lesson
    solver, other = reduced(), reduced()
    solver.step(24)
    for n in (1, 10, 13):
        other.step(n)
    assert torch.equal(solver.record.xhat, other.record.xhat)
    assert torch.equal(solver.record.stress, other.record.stress)
    assert solver.engine == "recurrence"
    assert solver.trajectory().stops == ["recurrence"] * 24
    assert (solver.left_grid(), solver.needed_outside(), solver.integration_mean) == (-1, 0, 0.0)
    first = solver.record.xhat.clone()
    solver.restart()
    solver.step(24)
    assert torch.equal(solver.record.xhat, first)
    kept = Rollout.open(pipeline.deployment.path / "rollout_0.h5")
    np.testing.assert_array_equal(kept.xhat, first.numpy())
    np.testing.assert_array_equal(kept.stress, solver.record.stress.numpy())


def test_a_run_searches_no_particles_that_it_does_not_move(lesson, monkeypatch):
    pipeline, _ = lesson
    monkeypatch.setattr(NeighbourSearch, "superset", None)
    fresh = Pipeline(pipeline.config, say=lambda line: None, root=pipeline.root)
    solver = fresh.solver_at(pipeline.manifold(), angle(26.0))
    np.testing.assert_array_equal(solver.sets[0].integration, solver.sets[0].sample)


def test_stress_is_decoded_from_its_coordinates(reduced):
    solver = reduced()
    solver.step(24)
    at = solver.manifold.restrict(dtype=torch.float64)
    tau = at.stress_of(solver.record.stress[-1])
    np.testing.assert_allclose(solver.state.numpy()["tau"][:, 0, 1], tau[:, 1], rtol=1e-10, atol=1e-12)


def test_a_batch_is_its_runs(reduced, lesson, taught):
    pipeline, _ = lesson
    sample = reduced().setup.samples
    parameters = [{"friction_angle": value} for value in (23.0, 26.0, 37.0)]
    batch = nsf.reduced_batch(
        pipeline.scene, pipeline.manifold(), parameters, sample, engine=taught, device="cpu"
    )
    batch.step(24)
    for run, own in zip(batch.runs, parameters, strict=True):
        alone = reduced(parameters=own)
        alone.step(24)
        assert torch.equal(alone.record.xhat, run.record.xhat)


def test_a_run_goes_on_from_the_way_of_another(reduced):
    """x̂ of the record is where it goes on, and ŝ is found along the way there."""
    whole, solver = reduced(), reduced()
    whole.step(24)
    for name in ("now", "before", "xhat"):
        source = {"now": whole.record.xhat[11], "before": whole.record.xhat[10], "xhat": whole.record.xhat}[
            name
        ]
        getattr(solver.record, name).copy_(source)
    solver.record.row.fill_(11)
    solver.together.resume(11)
    solver.step(13)
    far = float((whole.record.xhat[-1] - whole.record.xhat[0]).abs().max())
    assert float((solver.record.xhat[-1] - whole.record.xhat[-1]).abs().max()) < 0.05 * far


@pytest.mark.parametrize(
    ("changes", "inside"),
    [({"scene.gravity": [0.0, 0.2, -3.9]}, True), ({"scene.gravity": [0.0, 1.0, -4.0]}, False)],
)
def test_gravity_may_be_another(reduced, lesson, changes, inside):
    pipeline, _ = lesson
    taught = Trust.open(pipeline.deployment.file(TRUST), pipeline.manifold()).reach
    changed = pipeline.scene.changed(changes)
    plain, own = reduced(), reduced(scene=changed)
    for run in (plain, own):
        run.step(12)
    assert np.abs(own.state.xhat - plain.state.xhat).max() > 1e-4
    t = own.dt * np.arange(own.total_steps)
    outside = taught.of_inputs(own.setup.values, own.acting_gravity(t), np.zeros((len(t), 0)), own.dt)
    assert (not outside) == inside


def test_another_manifold_step_or_scene_is_refused(reduced, lesson):
    pipeline, _ = lesson
    other = pipeline.manifold()
    other.training_latents[0] += 1e-6
    refused = [
        ({"manifold": other}, "another manifold"),
        ({"dt_multiplier": 1.5}, "another Δt"),
        ({"scene": pipeline.scene.changed({"material.nu": 0.25})}, "another scene"),
    ]
    for options, message in refused:
        with pytest.raises(ConfigError, match=re.escape(f"it was taught on {message}")):
            reduced(**options)


def test_a_name_is_not_enough(chain, tiny_manifold):
    with pytest.raises(ConfigError, match=re.escape("give nsf.recurrence.RecurrenceEngine.load(FILE)")):
        nsf.reduced(chain.scene, tiny_manifold, ANGLE, 20, engine="recurrence", device="cpu")


# -- members --------------------------------------------------------------------------------------------


def test_members_tell_of_the_error(reduced, tiny_trust):
    solver = reduced()
    run = rollouts(solver.together, [angle(26.0)], tiny_trust)[0]
    assert (run.by, set(run.stops)) == ("", {"latent"})
    members = solver.members
    assert members.shape == (2, 24 // solver.span.stride + 1, 4)
    x = solver.span.at_sample.position(torch.as_tensor(members[:, -1]))
    spread = float((x - x.mean(0)).square().sum((0, 2)).mean().sqrt())  # over one less than two members
    assert run.signal[0] < 1e-12
    assert run.signal[-1] == pytest.approx(spread, rel=0.3)  # S is no random sample of the particles
    solver.span._runs.loop.xhat[1, 0, -1] = torch.nan  # a lost member
    assert np.isinf(tiny_trust.signal_of(solver)[-1])


def test_a_rollout_keeps_who_took_its_steps(lesson):
    pipeline, _ = lesson
    kept = Rollout.open(pipeline.deployment.path / "rollout_0.h5")
    assert (kept.signal.shape, kept.stress.shape) == ((25,), (25, 4))
    assert pipeline.deployment.manifest["metrics"]["by"] == [""]
    row = pd.read_csv(pipeline.evaluation.path / "results.csv").iloc[0]
    assert row["fallback_share"] == 0.0
    assert row["flag"] == "unknown"
    assert row["teach_seconds"] == pytest.approx(pipeline.taught.manifest["metrics"]["teach_seconds"])
    offline = row["teach_seconds"] + pipeline.training.manifest["metrics"]["training_seconds"]
    assert row["break_even_runs"] > offline / (1e-3 * 40 * row["step_ms_full"])


def test_a_run_that_another_model_takes_costs_what_its_steps_cost(lesson, pipeline_at):
    pipeline, _ = lesson
    taken = pipeline_at(pipeline.root, *TAUGHT, "scene.design.test=[60]", "fallback=projected")
    for stage in ("simulate", "deploy", "evaluate"):
        taken.run(stage)
    row = pd.read_csv(taken.evaluation.path / "results.csv").iloc[0]
    cost = json.loads((taken.evaluation.path / "cost.json").read_text())
    assert (row["fallback_share"], row["flag"]) == (1.0, "red")
    assert row["total_ms"] == pytest.approx(cost["projected"]["total_ms"])
