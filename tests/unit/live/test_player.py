"""What is shown, by whom and when: without a browser and without a clock."""

import logging
import threading
import time

import numpy as np
import pytest
from angles import angle

from nsf.errors import ConfigError, InstabilityError
from nsf.live.model import LiveRun
from nsf.live.player import _HOLD, Player


def work(player):
    while player.work():
        pass


def test_it_plays_no_further_than_the_run_has_come(player):
    assert player.tick().step == 0
    player.work()
    reached = player.tick().run.reached
    assert 0 < reached < player.steps
    assert [player.tick().step for _ in range(50)][-1] == reached


def test_it_plays_to_the_end_stands_still_and_begins_again(player):
    work(player)
    shown = [player.tick().step for _ in range(player.steps + _HOLD + 2)]
    assert shown[: player.steps] == list(range(1, player.steps + 1))
    assert shown[player.steps : -2] == [player.steps] * _HOLD
    assert shown[-2:] == [0, 1]


def test_paused_it_stands_still(player):
    player.playing = False
    work(player)
    player.seek(7)
    assert [player.tick().step for _ in range(3)] == [7, 7, 7]
    for step, found in ((-5, 0), (10**6, player.steps)):
        player.seek(step)
        assert player.tick().step == found


def test_another_value_is_shown_once_it_has_come_as_far(player):
    player.playing = False
    work(player)
    player.seek(10)
    before = player.tick()
    player.steer([35.0])
    steps = []
    while player.tick().run is before.run:
        assert player.tick().step == 10
        player.work()
        steps.append(None)
    after = player.tick()
    assert (after.run.case, after.step) == (angle(35.0), 10)
    assert not after.run.finished
    assert abs(after.xhat - before.xhat).max() > 1e-3
    assert len(steps) > 1


def test_while_it_is_dragged_every_shown_run_is_of_a_value_that_was_asked_for(player):
    player.playing = False
    work(player)
    player.seek(8)
    seen, asked = [], [27.0 + 0.5 * k for k in range(12)]
    for value in asked:
        player.steer([value])
        player.work()
        seen.append(player.tick().run.case["friction_angle"])
    assert len(set(seen) - {26.0}) > 2  # it follows, and does not wait for the hand to rest
    assert set(seen) <= {26.0, *asked}
    work(player)
    assert player.tick().run.case == angle(asked[-1])
    assert player.tick().run.finished


def test_while_it_is_dragged_it_plays_on(player, monkeypatch):
    """Each run that is shown is ahead of what is shown, so that the next can be made meanwhile."""
    monkeypatch.setattr("nsf.live.player._LEAD", 6)
    work(player)
    shown = []
    for n in range(100):
        player.steer([25.0 + 0.1 * n])  # at every piece of work: no hand is faster
        player.work()
        if n % 3 == 0:
            shown.append(player.tick())
    steps = [moment.step for moment in shown]
    assert len({moment.run.case for moment in shown}) > 5
    assert steps[:24] == list(range(1, 25))


def test_a_run_that_was_made_is_not_made_again(player, monkeypatch):
    work(player)
    first = player.tick().run
    player.steer([30.0])
    work(player)
    monkeypatch.setattr(player.model, "start", lambda value: pytest.fail("started again"))
    player.steer([26.0])
    work(player)
    assert player.tick().run is first


def test_values_out_of_reach_change_nothing(player):
    with pytest.raises(ConfigError):
        player.steer([float("nan")])
    assert player.case == angle(26.0)


def test_its_thread_survives_a_value_that_the_scene_refuses(model, monkeypatch, caplog):
    start = model.start

    def refuse(value):
        if value == angle(40.0):
            raise InstabilityError("dt=1 s is unstable")
        return start(value)

    monkeypatch.setattr(model, "start", refuse)
    with caplog.at_level(logging.WARNING), Player(model) as player:
        player.steer([40.0])
        wait_until(lambda: player.case == angle(26.0))
        player.steer([30.0])
        wait_until(lambda: player.tick().run.case == angle(30.0))
    assert "friction_angle=40°: dt=1 s is unstable" in caplog.text


def test_its_thread_survives_a_run_that_fails(model, monkeypatch):
    def fail(*_):
        raise RuntimeError("no memory")

    with Player(model) as player:
        monkeypatch.setattr(LiveRun, "advance", fail)
        wait_until(lambda: player.tick().run.finished)
        monkeypatch.undo()
        player.steer([34.0])
        wait_until(lambda: player.tick().run.case == angle(34.0))


def test_many_may_steer_at_once(model):
    with Player(model) as player:
        threads = [
            threading.Thread(target=lambda k=k: [player.steer([20.0 + k + 0.1 * n]) for n in range(40)])
            for k in range(8)
        ]
        for thread in threads:
            thread.start()
        for _ in range(100):
            moment = player.tick()
            assert moment.step <= moment.run.reached
        for thread in threads:
            thread.join()
        player.steer([30.0])
        wait_until(lambda: player.tick().run.case == angle(30.0))


def wait_until(true):
    end = time.monotonic() + 120.0  # after which something is broken, however busy the machine is
    while not true():
        assert time.monotonic() < end, "nothing happened within 120 s"
        time.sleep(0.01)


# -- gravity by hand ----------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_tilt_holds_from_the_shown_step_on(tilting_model):
    player = Player(tilting_model)
    player.playing = False
    work(player)
    player.seek(30)
    before = player.tick().run
    player.tilt([0.3, 0.0])
    work(player)
    after = player.tick().run
    assert after is not before
    assert (after.by_hand, after.case, after.finished) == (True, before.case, True)
    np.testing.assert_array_equal(after.xhat(30), before.xhat(30))
    other = tilting_model.tilted(before, 30, [-0.3, 0.0])
    other.advance(other.steps)
    aside = [run.positions(run.steps)[:, 0].mean() for run in (after, other)]
    assert aside[0] - aside[1] > 0.01
    assert after.verdict(30).text == before.verdict(30).text
    player.tilt(None)
    work(player)
    assert player.tick().run is before


@pytest.mark.slow
def test_beyond_what_programs_may_give_a_tilt_is_red(tilting_model):
    assert tilting_model.tilt == pytest.approx(np.radians(35.0))
    run = tilting_model.start(tilting_model.initial)
    run.advance(20)
    gone = tilting_model.tilted(run, 20, [0.0, 1.2 * tilting_model.tilt])
    gone.advance(1)
    assert not gone.verdict(20).beyond
    assert "gravity is" in gone.verdict(21).text


def test_a_run_by_a_recurrence_is_what_is_shown(taught_model):
    player = Player(taught_model)
    work(player)
    run = player.tick().run
    solver = taught_model.pipeline.solver_at(taught_model.manifold, run.case)
    assert solver.engine == "recurrence"
    solver.step(run.steps)
    np.testing.assert_allclose(run.xhat(run.steps), solver.state.xhat, atol=1e-4)
    assert taught_model.tilt is None
