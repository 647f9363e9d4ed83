"""Costs: what is reported, never how large it is."""

import json
from dataclasses import asdict

import numpy as np
import pytest
import torch

import nsf
from nsf.evaluation import Subject, at_frames, decoding_ms, measure
from nsf.kinematics.fields.modal import RestrictedField

REDUCED = ["inference", "p2g", "g2p", "inversion"]
FULL = ["p2g", "grid", "g2p", "stress"]


@pytest.fixture(scope="module")
def cost(chain, tiny_manifold):
    scene, angle = chain.scene, {"friction_angle": 26.0}
    full = Subject(lambda: scene.full_order(angle, device="cpu"), 24)
    reduced = Subject(lambda: nsf.reduced(scene, tiny_manifold, angle, 20, device="cpu"), 24)
    return measure({"full": full, "reduced": reduced}, 3, "cpu")


@pytest.fixture(scope="module")
def full(cost):
    return cost["full"]


@pytest.fixture(scope="module")
def reduced(cost):
    return cost["reduced"]


def test_a_run_is_decoded_at_every_frame(chain, tiny_manifold, made, monkeypatch):
    solver = nsf.reduced(chain.scene, tiny_manifold, {"friction_angle": 26.0}, 20, device="cpu")
    decoded = []
    blocks = RestrictedField.blocks
    monkeypatch.setattr(
        RestrictedField, "blocks", lambda self, *of: decoded.append(of[0]) or blocks(self, *of)
    )
    assert decoding_ms(solver, made, 2) > 0
    frames = torch.cat(decoded).reshape(3, 25, 4)  # once before, twice timed
    np.testing.assert_allclose(frames[0], at_frames(made, 0.005 * np.arange(25)), rtol=1e-6)


def test_stages_are_those_of_a_step(full, reduced):
    assert sorted(reduced.stages) == sorted(REDUCED)
    assert sorted(full.stages) == sorted(FULL)
    assert min([*reduced.stages.values(), *full.stages.values()]) > 0


def test_what_a_cost_holds(full, reduced):
    for cost in (full, reduced):
        assert cost.trials == 3
        assert 0 < cost.step_ms_p10 <= cost.step_ms <= cost.step_ms_p90
        assert cost.total_ms > 0
        assert cost.memory_mib > 0
        keys = {
            "step_ms",
            "step_ms_p10",
            "step_ms_p90",
            "total_ms",
            "stages",
            "memory_mib",
            "trials",
            "steps",
        }
        assert set(json.loads(json.dumps(asdict(cost)))) == keys


class Counted:
    """Counts its steps; the first two take long, as those that compile do."""

    nbytes = 2**20

    def __init__(self, name="only", log=None, clock=None):
        self.name, self.log, self.clock = name, [] if log is None else log, clock
        self.steps, self.timed = 0, []

    def step(self, n=1):
        self.log.append(self.name)
        for _ in range(n):
            if self.clock is not None:
                self.clock.now += 100.0 if self.steps < 2 else 0.25
            self.steps += 1

    def timed_step(self, timer):
        with timer("only"):
            self.timed.append(self.steps)
            self.steps += 1


@pytest.fixture
def clock(monkeypatch):
    class Clock:
        now = 0.0

    monkeypatch.setattr("time.perf_counter", lambda: Clock.now)
    monkeypatch.setattr("gc.collect", lambda: 0)  # a second each, for nothing
    return Clock


@pytest.mark.parametrize(("steps", "trials"), [(200, 10), (24, 10), (5, 10), (3, 1), (2, 10), (1, 2)])
def test_every_trial_is_a_whole_run(steps, trials, clock):
    solvers = []

    def build():
        solvers.append(Counted(clock=clock))
        return solvers[-1]

    cost = measure({"it": Subject(build, steps)}, trials, "cpu")["it"]
    assert len(solvers) == trials + 1  # and one for the stages
    assert cost.trials == trials
    assert [s.steps for s in solvers[:-1]] == [steps] * trials
    last = solvers[-1]
    assert last.steps == steps
    assert last.timed[-1] == steps - 1  # spread to the end of the run
    assert last.timed == sorted(set(last.timed))
    if steps > 2:
        assert cost.step_ms == pytest.approx(250.0)  # without the steps that compile
        assert cost.total_ms == pytest.approx(2e5 + 250.0 * (steps - 2))  # with them


def test_solvers_take_turns(clock):
    log = []
    subjects = {n: Subject(lambda n=n: Counted(n, log), 5) for n in ("full", "reduced")}
    measure(subjects, 3, "cpu")
    runs = log[: 2 * 2 * 3]
    assert runs == ["full", "full", "reduced", "reduced"] * 3
