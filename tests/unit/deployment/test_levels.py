"""Who takes the steps of a run, on a motion made up: x̂ goes on as it went, and a model misses some steps."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from angles import angle

from nsf.deployment import FULL_ORDER, LATENT_MODEL, PROJECTED, Fallback, Rollout, rollouts
from nsf.dynamics import ReducedBatch, Sources
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

    def spread(self, steps):
        return torch.arange(steps + 1.0)[None].expand(len(self.record.row), -1)


class Straying(Line):
    kicks, kick = tuple(range(STEPS)), 20.0 * CHANGE


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

        inside = lambda setup, gravity: (0.0, "")  # noqa: E731
        return ReducedBatch(runs, SimpleNamespace(name="latent", spans=spans, doubt=doubt or inside))

    return build


@pytest.fixture
def shared(batch_of, tiny_trust):
    """(model, projected step, who goes on) → the run at 26° that both take."""

    def run(model, projected, to="none", values=(26.0,), doubt=None, **changed):
        cases = list(map(angle, values))
        fallback = Fallback(to, lambda cases: batch_of(projected, cases, **changed))
        return rollouts(batch_of(model, cases, doubt), cases, tiny_trust, fallback)

    return run


def test_a_run_that_is_not_believed_is_taken_to_its_end(shared, batch_of, tmp_path):
    (found,) = shared(Straying, Line, "projected")
    n = found.by_latent_model
    assert 0 < n < STEPS
    assert found.levels.tolist() == [LATENT_MODEL] * n + [PROJECTED] * (STEPS - n)
    alone = batch_of(Straying).runs[0]
    alone.step(STEPS)
    np.testing.assert_array_equal(found.xhat[: n + 1], alone.record.xhat[: n + 1].numpy())
    changes = np.diff(found.xhat[n - 1 :], axis=0)
    np.testing.assert_allclose(changes, np.broadcast_to(changes[0], changes.shape), rtol=0, atol=1e-12)
    assert (found.estimate[n:] == found.estimate[n]).all()
    (kept,) = shared(Straying, Line)
    assert (kept.levels == LATENT_MODEL).all()
    found.save(tmp_path / "rollout_0.h5")
    read = Rollout.open(tmp_path / "rollout_0.h5")
    np.testing.assert_array_equal(read.levels, found.levels)
    assert read.by_latent_model == n


def test_a_run_that_is_doubted_is_the_projected_steps_from_the_start(shared):
    (found,) = shared(Line, Line, "projected", doubt=lambda setup, gravity: (1.5, "outside"))
    assert (found.levels == PROJECTED).all()
    assert (found.estimate == 0.0).all()


def test_the_projected_step_goes_on_where_forcing_is_beyond_training(batch_of, tiny_trust):
    fallback = Fallback("projected", lambda cases: batch_of(Line, cases))
    weak = replace(tiny_trust, gravity=((0.0, 0.0, 0.0), 1.0))  # m/s², where the scene has 9.81
    (found,) = rollouts(batch_of(Line), [angle(26.0)], weak, fallback)
    assert (found.levels == PROJECTED).all()


def test_a_run_that_the_full_order_solver_takes_from_the_start_can_be_read(batch_of, tiny_trust, tmp_path):
    cases = [angle(60.0)]  # outside of the box
    fallback = Fallback("full", lambda cases: batch_of(Line, cases))
    batch = batch_of(Line, cases, lambda setup, gravity: (2.5, "outside"))
    (found,) = rollouts(batch, cases, tiny_trust, fallback)
    assert (found.handed_over, len(found.stops)) == (0, 0)
    found.save(tmp_path / "rollout_0.h5")
    kept = Rollout.open(tmp_path / "rollout_0.h5")
    assert kept.trust.shape == (1,)
    assert kept.trust[0] > 1.0


def test_the_full_order_solver_goes_on_with_a_recurrence(batch_of, tiny_trust):
    fallback, cases = Fallback("full", lambda cases: batch_of(Line, cases)), [angle(26.0)]
    (found,) = rollouts(batch_of(Straying, cases), cases, tiny_trust, fallback)
    assert 0 < found.handed_over < found.distrusted == len(found.stops)
    assert (found.levels[: found.handed_over] == LATENT_MODEL).all()
    assert (found.levels[found.handed_over :] == FULL_ORDER).all()


def test_a_run_whose_particles_carry_stress_is_taken_anew(shared, batch_of):
    """From t = 0: in its midst the stress that they would carry is not known."""
    sources = Sources("particles", "particles")
    (found,) = shared(Straying, Line, "projected", sources=sources)
    assert (found.levels == PROJECTED).all()
    assert (found.estimate == 0.0).all()
    straight = batch_of(Line).runs[0]
    straight.step(STEPS)
    np.testing.assert_array_equal(found.xhat, straight.record.xhat.numpy())
    (kept,) = shared(Line, Line, "projected", sources=sources)
    assert (kept.levels == LATENT_MODEL).all()


def test_each_run_of_a_batch_is_handed_on_by_itself(shared):
    many = shared(Straying, Line, "projected", values=(23.0, 26.0))
    for value, run in zip((23.0, 26.0), many, strict=True):
        (alone,) = shared(Straying, Line, "projected", values=(value,))
        np.testing.assert_array_equal(run.levels, alone.levels)
        np.testing.assert_allclose(run.xhat, alone.xhat, rtol=0, atol=1e-12)


def test_a_run_that_is_not_finite_is_handed_on(shared):
    class Lost(Line):
        kicks, kick = (5,), np.nan

    (found,) = shared(Lost, Line, "projected")
    assert found.by_latent_model < 6
    assert np.isfinite(found.xhat).all()
    (lost,) = shared(Lost, Line)
    assert lost.diverged == 6
