"""Projected steps with a closure, from its fit to its errors, on the tiny chain; and what is refused."""

import shutil
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import torch
from angles import angle

from nsf.engines import Closed, Operators
from nsf.engines.closed import Closing, Linearised
from nsf.engines.closed.linear import Known
from nsf.engines.operators import StepOperators, Taught
from nsf.engines.operators.teacher import Teacher
from nsf.engines.reference import Reference
from nsf.errors import ConfigError, SchemaError

CLOSED = (
    "engine=closed",
    "engine.closing.descent=150",
    "engine.closing.unroll=16",
    "engine.closing.width=32",
)
CASE = angle(26.0)


@pytest.fixture(scope="module")
def lesson(chain, pipeline_at, tmp_path_factory):
    """The tiny chain by projected steps with a closure, and what it said."""
    root, said = tmp_path_factory.mktemp("closed") / "runs", []
    for stage in ("simulate", "train"):
        shutil.copytree(chain.root / stage, root / stage)
    pipeline = pipeline_at(root, *CLOSED, say=said.append)
    for stage in ("deploy", "evaluate"):
        pipeline.run(stage)
    return pipeline, said


@pytest.fixture
def engine(lesson):
    """The engine of the file that was written."""
    return Closed.load(lesson[0].taught.file("operators.pt"))


@pytest.fixture
def batch(lesson):
    """(engine, *cases) → runs of the tiny scene."""
    pipeline, _ = lesson
    manifold = pipeline.manifold()
    return lambda engine, *cases, **how: pipeline.batch_at(manifold, cases or [CASE], engine=engine, **how)


def silent(engine: Closed, pushes: bool = False) -> Closed:
    """The same engine whose closure gives nothing, or what differs from the mean gravity alone."""
    last, r = engine.model.net[4], engine.model.sizes.latents
    last.weight.zero_()
    last.bias.zero_()
    if pushes:
        last.bias[r * r + r :] = 1.0
    return engine


def remembering(plain: StepOperators) -> StepOperators:
    """The same network, which also sees two lags through weights by chance."""
    model = StepOperators(replace(plain.sizes, memory=2), plain.dt).double().requires_grad_(False)
    known = {name: values for name, values in plain.state_dict().items() if name != "net.0.weight"}
    model.load_state_dict(known, strict=False)
    model.net[0].weight[:, : plain.sizes.inputs] = plain.net[0].weight
    model.lag_decay.copy_(torch.tensor([0.5, 0.9]))
    model.lag_scale.copy_(0.1 * plain.d_scale.repeat(2))
    return model


def test_held_out_errors_are_smaller_than_without_it(chain, lesson):
    pipeline, said = lesson
    errors = [
        pd.read_csv(run.path / "results.csv")["displacement_error"].mean()
        for run in (chain.pipeline.evaluation, pipeline.evaluation)
    ]
    assert errors[1] < 0.5 * errors[0]
    before, after = pipeline.taught.manifest["metrics"]["errors"]
    assert after < 0.5 * before
    assert any("% without it" in line for line in said)
    assert "deploy: engine closed, since it was asked for" in said


def test_a_step_is_a_projected_step_and_what_the_closure_gives(engine, batch):
    closed, projected = batch(engine), batch("modal")
    for run in (closed, projected):
        run.step()
    setup, model = closed.batch.setups[0], engine.model
    first = closed.span_at(0).closure._first
    c = model.collider_state(torch.zeros(model.sizes.features, dtype=torch.float64))
    xhat, change = Known.of(_runs(setup.manifold)).within(setup.xhat[None], first)
    pushed = model.acceleration(xhat, change, setup.parameters, torch.as_tensor(setup.gravity.values[0]), c)
    assert pushed.abs().max() > 1e-6
    torch.testing.assert_close(closed.xhat - projected.xhat, pushed, rtol=1e-9, atol=1e-12)


def test_a_closure_with_a_memory_sees_the_lags(engine, batch):
    """The second step is that of the projection, and what the closure gives at the lags of the first."""
    model = remembering(engine.model)
    sizes = model.sizes
    closed = batch(Closed(model, engine.taught, engine.samples))
    closed.step(2)
    start, once, twice = closed.batch.record.xhat[:, :3].double().unbind(1)
    projected = Teacher([batch("modal")]).step_from(1, once, once - start)
    setup = closed.batch.setups[0]
    c = model.collider_state(torch.zeros(sizes.features, dtype=torch.float64))
    given = setup.parameters, torch.as_tensor(setup.gravity.values[0]), c
    near = Known.of(_runs(setup.manifold)).within(once, once - start)
    lag = model.next_lag(torch.zeros(1, sizes.lags, dtype=torch.float64), once - start)
    expected = model.acceleration(*near, *given, lag)
    assert (expected - model.acceleration(*near, *given, 0.0 * lag)).abs().max() > 1e-6
    torch.testing.assert_close(twice - projected, expected, rtol=1e-6, atol=1e-10)
    again = batch(Closed(model, engine.taught, engine.samples))
    again.step(1)
    again.step(1)
    assert torch.equal(again.batch.record.xhat[:, 2], closed.batch.record.xhat[:, 2])


def test_a_hand_on_gravity_leaves_the_memory(engine, batch):
    """What a hand sets to the gravity there is changes nothing of a run by operators."""
    own = Operators(remembering(engine.model), engine.taught, engine.samples)
    left, handed = batch(own), batch(own)
    left.step(8)
    handed.step(4)
    handed.hand().gravity = tuple(handed.batch.setups[0].gravity.values[0])
    handed.step(4)
    assert torch.equal(left.batch.record.xhat[:, :9], handed.batch.record.xhat[:, :9])


def _runs(manifold):
    count = int(manifold.training_trajectories[-1]) + 1
    return manifold.training_latents.unflatten(0, (count, -1)).transpose(0, 1)


def test_a_closure_that_gives_nothing_changes_nothing(engine, batch):
    runs = [batch(silent(engine)), batch("modal")]
    for run in runs:
        run.step(run.total_steps)
    torch.testing.assert_close(*(run.batch.record.xhat for run in runs), rtol=0, atol=1e-5)


def test_over_the_reference_and_over_modal_it_is_the_same(engine, batch, monkeypatch):
    over_modal = batch(engine)
    monkeypatch.setattr("nsf.engines.choice.ENGINES", (Reference(),))
    over_reference = batch(engine)
    assert "transfer" in over_reference.stages
    assert list(over_modal.stages)[-1] == list(over_reference.stages)[-1] == "closure"
    for run in (over_modal, over_reference):
        run.step(run.total_steps)
    torch.testing.assert_close(
        over_modal.batch.record.xhat, over_reference.batch.record.xhat, rtol=0, atol=1e-4
    )


def test_a_hand_on_gravity_reaches_the_closure(engine, batch):
    runs = [batch(silent(engine, pushes=True)), batch("modal")]
    for run in runs:
        run.step(5)
    torch.testing.assert_close(runs[0].xhat, runs[1].xhat, rtol=0, atol=1e-6)  # gravity is at its mean
    for run in runs:
        run.hand().gravity = (1.0, 0.0, -5.0)
        run.step()
    model = engine.model
    pushed = model.a_scale * (torch.tensor([1.0, 0.0, -5.0]).double() - model.g_mean).sum() / model.g_scale
    torch.testing.assert_close((runs[0].xhat - runs[1].xhat)[0], pushed, rtol=1e-4, atol=1e-6)


def test_runs_together_are_as_alone_and_begin_again(engine, batch):
    together = batch(engine, angle(24.0), CASE)
    together.step(together.total_steps)
    alone = batch(engine)
    for _ in range(2):
        for n in range(alone.total_steps):
            alone.step()
            assert torch.equal(alone.batch.record.xhat[0, n + 1], alone.xhat[0])
        torch.testing.assert_close(
            alone.batch.record.xhat[0], together.batch.record.xhat[1], rtol=0, atol=1e-9
        )
        found = alone.batch.record.xhat.clone()
        alone.restart()
    alone.step(alone.total_steps)
    assert torch.equal(alone.batch.record.xhat, found)


def test_a_run_outside_of_training_is_corrected_as_at_the_edge(engine, batch):
    """Else a network would be asked where it knows nothing, step after step."""
    far, further = (batch(engine) for _ in range(2))
    pushes = []
    for run, way in ((far, 5.0), (further, 50.0)):
        run.batch.record.now += way
        run.batch.record.before += way
        run.batch.record.row.fill_(2)
        closure = run.span.closure
        closure._change.zero_()
        before = run.xhat.clone()
        closure.add()
        pushes.append(run.xhat - before)
    torch.testing.assert_close(*pushes, rtol=1e-9, atol=1e-12)
    assert pushes[0].abs().max() > 0


def test_the_equations_of_a_projection_are_those_before_the_closure(engine, batch):
    found = []
    for by in (engine, "modal"):
        run = batch(by).runs[0]
        run.step(6)
        found.append(run.equations_at(5, run.record.xhat[5] * 0 + 0.3, run.record.xhat[4] * 0 + 0.29))
    for one, other in zip(*found, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-6, atol=1e-9)


class Springs:
    """A teacher whose step is known: P − d = A x̂ + W d + D of each step."""

    def __init__(self, r=3, runs=2, steps=9):
        torch.manual_seed(0)
        self.A, self.W = (0.1 * torch.randn(r, r, dtype=torch.float64) for _ in range(2))
        self.lacks = torch.randn(steps, runs, r, dtype=torch.float64)
        self.total_steps, self.first = steps, torch.randn(runs, r, dtype=torch.float64)
        x, d, found = torch.zeros(runs, r, dtype=torch.float64), self.first, []
        for n in range(steps):
            found.append(x)
            d = d + x @ self.A.T + d @ self.W.T + self.lacks[n]
            x = x + d
        self.runs = torch.stack([*found, x])

    def first_change(self):
        return self.first

    def step_from(self, n, xhat, change):
        return xhat + change + xhat @ self.A.T + change @ self.W.T


@pytest.mark.parametrize("stride", [1, 4])
def test_a_known_step_is_linearised(stride):
    springs = Springs()
    found = Linearised.along(springs, springs.runs, stride)
    torch.testing.assert_close(found.defect, springs.lacks, rtol=0, atol=1e-10)
    for slopes, known in ((found.of_x, springs.A), (found.of_d, springs.W)):
        assert len(slopes) == -(-9 // stride)
        torch.testing.assert_close(slopes, known.expand_as(slopes), rtol=0, atol=1e-10)
    assert found.lost == 0.0


def test_a_step_that_is_lost_is_counted():
    springs = Springs()
    springs.step_from = lambda n, xhat, change: xhat * float("nan")
    assert Linearised.along(springs, springs.runs, 4).lost == 1.0


@pytest.mark.gpu
def test_a_captured_step_is_the_step_of_a_cpu(engine, lesson):
    pipeline, _ = lesson
    manifold = pipeline.manifold()
    ends = []
    for device in ("cpu", "cuda"):
        run = pipeline.batch_at(manifold, [CASE], device, engine=engine)
        run.step(run.total_steps)
        ends.append(run.batch.record.xhat.cpu())
    torch.testing.assert_close(*ends, rtol=0, atol=1e-4)


def test_it_is_fitted_to_the_same_bits_again(lesson, pipeline_at, tmp_path):
    keys, found = (*CLOSED, "engine.closing.descent=6"), []
    for root in (tmp_path / "one", tmp_path / "other"):
        for stage in ("simulate", "train"):
            shutil.copytree(lesson[0].root / stage, root / stage)
        run = pipeline_at(root, *keys).teach()
        found.append(Closed.load(run.file("operators.pt")).model.state_dict())
    assert all(torch.equal(value, found[1][name]) for name, value in found[0].items())


def test_a_file_is_of_one_engine(lesson, engine, tmp_path):
    with pytest.raises(SchemaError, match=r"taught for engine=closed, not for engine=operators"):
        Operators.load(lesson[0].taught.file("operators.pt"))
    path = tmp_path / "operators.pt"
    engine.model.save(path, engine.taught, engine.samples)
    with pytest.raises(SchemaError, match=r"taught for engine=operators, not for engine=closed"):
        Closed.load(path)


def test_it_is_used_on_nothing_else(engine, batch):
    other = Closed(engine.model, Taught(**vars(engine.taught) | {"dt": 1.0}), engine.samples)
    with pytest.raises(ConfigError, match=r"taught on another Δt"):
        batch(other)
    with pytest.raises(ConfigError, match=r"nsf\.engines\.Closed\.load\(FILE\)"):
        batch("closed")


@pytest.mark.parametrize(
    ("value", "told"),
    [
        ({"unroll": 0}, "unroll=0 must be at least 1"),
        ({"stride": 10**20}, "stride=1.* must be at least 1 and at most 10,000"),
        ({"rate": float("nan")}, "rate=nan must be finite"),
        ({"rate": 0.0}, "rate=0 fits nothing"),
        ({"single": -1.0}, "single=-1.0 must be finite and at least 0"),
    ],
)
def test_values_that_cannot_be_meant(value, told):
    with pytest.raises(ConfigError, match=told):
        Closing(**value)


@pytest.mark.parametrize(
    "key", ["deploy.dt_multiplier=1.5", "deploy.tolerance=0.1", "deploy.on_distrust=projected"]
)
def test_keys_that_do_not_go_with_it(lesson, pipeline_at, key):
    with pytest.raises(ConfigError, match=key.split("=")[0].replace(".", r"\.")):
        pipeline_at(lesson[0].root, *CLOSED, key)


def test_a_closure_is_told_of_nothing_outside_of_training():
    runs = torch.linspace(0.0, 1.0, 11, dtype=torch.float64)[:, None, None].expand(11, 2, 3)
    x, d = Known.of(runs).within(torch.full((1, 3), 5.0).double(), torch.full((1, 3), -5.0).double())
    np.testing.assert_allclose(x, 1.1)
    np.testing.assert_allclose(d, 0.1)
