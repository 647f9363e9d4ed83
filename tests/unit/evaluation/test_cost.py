"""Costs: what is reported, never how large it is."""

import json

import numpy as np
import pytest

from nsf.evaluation import measure

REDUCED = ["inference", "transfer", "p2g", "grid", "g2p", "inversion"]
FULL = ["p2g", "grid", "g2p", "stress"]


@pytest.fixture(scope="module")
def full(chain):
    return measure(lambda: chain.scene.full_order({"friction_angle": 26.0}, device="cpu"), 24, 3, "cpu")


@pytest.fixture(scope="module")
def reduced(chain, tiny_manifold):
    build = chain.scene.reduced
    return measure(lambda: build(tiny_manifold, {"friction_angle": 26.0}, 20, device="cpu"), 24, 3, "cpu")


def test_stages_are_those_of_the_issue(full, reduced):
    """Issue 2: inference, P2G, grid, G2P, inversion, transfer."""
    assert sorted(reduced.stages) == sorted(REDUCED)
    assert sorted(full.stages) == sorted(FULL)
    assert min([*reduced.stages.values(), *full.stages.values()]) > 0


def test_what_a_cost_holds(full, reduced):
    for cost in (full, reduced):
        assert cost.trials == 3
        assert 0 < cost.step_ms_p10 <= cost.step_ms <= cost.step_ms_p90
        assert cost.total_ms > 0
        assert cost.memory_mib > 0
        assert cost.allocators
        keys = {
            "step_ms",
            "step_ms_p10",
            "step_ms_p90",
            "total_ms",
            "stages",
            "memory_mib",
            "allocators",
            "trials",
        }
        assert set(json.loads(json.dumps(cost.as_dict()))) == keys


class Counted:
    """Counts its steps and takes them in no time."""

    built = 0
    nbytes = 2**20

    def __init__(self):
        Counted.built += 1
        self.steps, self.calls = 0, []

    def step(self, n=1):
        self.calls.append(n)
        self.steps += n

    def timed_step(self, timer):
        with timer("only"):
            self.steps += 1


@pytest.mark.parametrize(
    ("steps", "repeats", "trials"),
    [(200, 10, 10), (24, 10, 10), (5, 10, 3), (3, 1, 1), (2, 10, 1), (1, 2, 1)],
)
def test_a_run_in_equal_parts_never_passes_its_end(steps, repeats, trials, monkeypatch):
    monkeypatch.setattr("gc.collect", lambda: 0)  # a second each, for nothing
    solvers = []

    def build():
        solvers.append(Counted())
        return solvers[-1]

    cost = measure(build, steps, repeats, "cpu")
    assert cost.trials == trials
    assert all(solver.steps <= steps for solver in solvers)
    assert len(set(solvers[0].calls[1:])) == 1
    assert np.isfinite(cost.total_ms)
