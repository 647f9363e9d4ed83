"""Levels of a run, on a motion made up: x̂ goes on as it went, and operators miss some of its steps."""

from importlib import import_module

import numpy as np
import pytest
import torch
from angles import angle

from nsf.deployment import OPERATORS, PROJECTED, Levels, Rollout, rollouts
from nsf.deployment.levels import _carried
from nsf.dynamics import History, ReducedBatch
from nsf.dynamics.span import Span

STEPS, CHANGE = 24, 1e-3


class Line(Span):
    """x̂_{n+1} = x̂_n + d, with a kick to some steps; what S is does not matter."""

    latent_only = True
    kicks: tuple[int, ...] = ()
    kick = 10.0 * CHANGE

    @property
    def stages(self):
        return {"line": lambda: self.take(1)}

    def enter(self, first):
        self.change = (
            torch.full_like(self.record.now, CHANGE) if first else self.record.now - self.record.before
        )

    def next(self, n, xhat, change):
        change = change + (self.kick if n in self.kicks else 0.0)
        return xhat + change, change

    def take(self, steps):
        record = self.record
        for _ in range(steps):
            n = int(record.row[0])
            record.before.copy_(record.now)
            now, self.change = self.next(n, record.now, self.change)
            record.now.copy_(now)
            record.row += 1
            record.xhat[:, n + 1] = now

    def pushed(self, push, since=0):
        found = self.record.xhat.clone()
        xhat = found[:, since]
        change = xhat - found[:, since - 1] if since else torch.full_like(xhat, CHANGE)
        for n in range(since, push.shape[1]):
            xhat, change = self.next(n, xhat, change + push[:, n])
            found[:, n + 1] = xhat
        return found[:, : push.shape[1] + 1]


class Kicked(Line):
    kicks = (8, 9, 10)


class Off(Kicked):
    """Misses a little before it is kicked."""

    def next(self, n, xhat, change):
        return super().next(n, xhat, change + (0.01 * CHANGE if n == 1 else 0.0))


class Straying(Line):
    kicks, kick = tuple(range(STEPS)), 20.0 * CHANGE


class Returning(Line):
    """Whatever it begins with, the step ends on a training trajectory."""

    def next(self, n, xhat, change):
        there = self.batch.shared.manifold.training_latents[n + 1].to(xhat).expand_as(xhat)
        return there, there - xhat


@pytest.fixture
def batch_of(chain, tiny_manifold):
    """(span, cases) → runs whose steps that class of spans takes."""

    def build(span, cases=(angle(26.0),), doubt=None, **changed):
        runs = [chain.pipeline.solver_at(tiny_manifold, case, engine="modal").setup for case in cases]
        for run in runs:
            vars(run).update(changed)

        def spans(batch):
            at = tiny_manifold.restrict(batch.shared.samples[0].particles, dtype=torch.float64)
            return [span(batch, batch.shared.sets[0], at)]

        return ReducedBatch(runs, spans, engine="operators", **({"doubt": doubt} if doubt else {}))

    return build


@pytest.fixture
def shared(batch_of, tiny_trust):
    """(operators, projected step, how) → the run at 26° that both take."""

    def run(operators, projected, *how, values=(26.0,), doubt=None, **changed):
        cases = list(map(angle, values))
        levels = Levels(lambda cases: batch_of(projected, cases, **changed), *how)
        return rollouts(batch_of(operators, cases, doubt), cases, tiny_trust, levels=levels)

    return run


def test_a_run_that_leaves_comes_home(shared, batch_of, tmp_path):
    (found,) = shared(Kicked, Line, 1, 1e-4)
    assert found.levels.tolist() == [OPERATORS] * 8 + [PROJECTED] * 3 + [OPERATORS] * 13
    straight = batch_of(Line).runs[0]
    straight.step(STEPS)
    np.testing.assert_allclose(found.xhat, straight.record.xhat.numpy(), rtol=0, atol=1e-12)
    assert found.estimate.max() < 1e-9
    alone = batch_of(Kicked).runs[0]
    alone.step(STEPS)
    assert np.abs(found.xhat - alone.record.xhat.numpy()).max() > 0.1
    found.save(tmp_path / "rollout_0.h5")
    kept = Rollout.open(tmp_path / "rollout_0.h5")
    np.testing.assert_array_equal(kept.levels, found.levels)
    assert kept.by_operators == found.by_operators == 21


def test_a_run_that_the_full_order_solver_takes_from_the_start_can_be_read(batch_of, tiny_trust, tmp_path):
    """As in a case outside of the box: operators are doubted there, and the projected step distrusted."""
    cases = [angle(60.0)]
    levels = Levels(lambda cases: batch_of(Line, cases), 2, None, True)
    batch = batch_of(Line, cases, lambda setup, gravity: (2.5, "outside"))
    (found,) = rollouts(batch, cases, tiny_trust, until_distrusted=True, levels=levels)
    assert (found.handed_over, len(found.stops)) == (0, 0)
    found.save(tmp_path / "rollout_0.h5")
    kept = Rollout.open(tmp_path / "rollout_0.h5")
    assert kept.trust.shape == (1,)
    assert kept.trust[0] > 1.0


def test_the_solver_that_checks_is_built_before_the_clock_starts(batch_of, tiny_trust, monkeypatch):
    done, module = [], import_module("nsf.deployment.rollout")  # whose name in the package is a function's
    timed = module._timed_run
    monkeypatch.setattr(module, "_timed_run", lambda *given: done.append("timed") or timed(*given))
    levels = Levels(lambda cases: done.append("built") or batch_of(Line, cases), 1)
    rollouts(batch_of(Line), [angle(26.0)], tiny_trust, levels=levels)
    assert done == ["built", "timed"]


def test_an_estimate_in_single_precision_overflows_no_earlier_than_positions(batch_of, tiny_manifold):
    batch, far = batch_of(Line), 1e21  # its square is no float32
    batch.step(STEPS)
    particles = batch.batch.shared.samples[0].particles
    batch.span_at(0).at_sample = tiny_manifold.restrict(particles, dtype=torch.float32)
    defects = torch.full((1, 1, batch.batch.record.xhat.shape[-1]), far)
    found = _carried(batch, [STEPS - 1], defects, 0)
    assert 1e19 < found[0, -1] < np.inf


def test_a_run_whose_particles_carry_stress_is_taken_anew(shared, batch_of):
    """From t = 0: in its midst the stress that they would carry is not known."""
    method = History("history", neural_stress=True, neural_affine=True)
    assert (shared(Off, Line, 1, 1e-4)[0].levels[:2] == OPERATORS).all()  # were it not for the method
    (found,) = shared(Off, Line, 1, 1e-4, method=method)
    assert (found.levels == PROJECTED).all()
    assert (found.estimate == 0.0).all()
    straight = batch_of(Line).runs[0]
    straight.step(STEPS)
    np.testing.assert_array_equal(found.xhat, straight.record.xhat.numpy())
    (kept,) = shared(Line, Line, 1, 1e-4, method=method)
    assert (kept.levels == OPERATORS).all()


def test_each_run_of_a_batch_comes_home_by_itself(shared):
    many = shared(Kicked, Line, 1, 1e-4, values=(23.0, 26.0))
    for value, run in zip((23.0, 26.0), many, strict=True):
        (alone,) = shared(Kicked, Line, 1, 1e-4, values=(value,))
        np.testing.assert_array_equal(run.levels, alone.levels)
        np.testing.assert_allclose(run.xhat, alone.xhat, rtol=0, atol=1e-12)


def test_an_error_that_was_made_is_not_forgotten(shared):
    """Operators that used up half of the tolerance do not try again, however well they would do."""
    alone = shared(Kicked, Line, 1)[0].estimate
    tolerance = float(0.5 * (alone[10] + alone[11]))
    (found,) = shared(Kicked, Line, 1, tolerance)
    n = int(np.argmax(found.levels == PROJECTED))
    assert 8 < n < 11
    assert alone[n] <= 0.5 * tolerance < alone[n + 1]
    assert found.estimate[n] == pytest.approx(alone[n])
    assert (found.estimate[n:] >= found.estimate[n]).all()
    assert (found.estimate <= tolerance).all()
    (little,) = shared(Kicked, Line, 1, 2.0 * float(alone[n]) * (1 + 1e-6))
    assert (little.levels == PROJECTED).sum() < STEPS - n


def test_who_left_the_training_data_comes_home_where_it_is_back(shared):
    (found,) = shared(Straying, Returning, 2, None, True)
    believed = found.trust <= 1.0
    assert believed.all()
    turns = np.flatnonzero(np.diff(found.levels.astype(int)) == OPERATORS - PROJECTED)
    assert len(turns) >= 2
    (doubted,) = shared(Straying, Returning, 2, None, True, doubt=lambda setup, gravity: (1.5, "outside"))
    assert (doubted.levels == PROJECTED).all()


def test_a_run_that_is_not_finite_is_handed_on_for_good(shared):
    class Lost(Line):
        kicks, kick = (5,), np.nan

    (found,) = shared(Lost, Line, 4)
    assert (found.levels == PROJECTED).all()
    assert np.isfinite(found.xhat).all()
    assert (found.estimate == 0.0).all()
    (back,) = shared(Lost, Line, 4, 1e-4)
    assert (back.levels[8:] == OPERATORS).all()
