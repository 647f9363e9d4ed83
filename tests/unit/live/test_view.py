"""`nsf view`: what it sends of a moment, and the page in a browser, without a network."""

import re

import numpy as np
import pytest
from test_player import wait_until
from test_server import threaded

pytest.importorskip("websockets", reason="websockets is not installed")

from angles import angle
from packing import unpacked

from nsf.live.coloring import DISTANCE, PRESSURE, SETS, STRESS, UNKNOWN, Coloring
from nsf.live.feeds import PointFeed, obey
from nsf.live.player import Moment, Player


@pytest.fixture(scope="module")
def coloring(model):
    return Coloring(model)


@pytest.fixture(scope="module")
def run(model):
    run = model.start(angle(26.0))
    run.advance(run.steps)
    return run


def test_every_colouring_of_every_moment(model, coloring, run):
    truth = model.truth(angle(26.0))
    for by in coloring.quantities:
        for step in (0, run.steps):
            for beside in (truth, None):
                reduced, full = coloring.shades(Moment(run, step), beside, by)
                assert reduced.shape == (200,)
                assert reduced.dtype == np.float32
                assert (full is None) == (beside is None)
                assert reduced.max() <= 1.0


def test_shades_say_what_they_are_of(model, coloring, run):
    truth, end = model.truth(angle(26.0)), Moment(run, run.steps)
    assert coloring.shades(Moment(run, 0), truth, "displacement")[0].max() < 5e-3
    assert np.ptp(coloring.shades(end, truth, "displacement")[0]) > 0.3
    assert not coloring.shades(end, truth, DISTANCE)[1].any()
    assert (coloring.shades(end, None, DISTANCE)[0] == UNKNOWN).all()  # grey, not small
    sets = coloring.shades(end, truth, SETS)[0]
    np.testing.assert_array_equal(sets, model.roles(run.steps) / 2)
    low, top = (coloring.quantities[PRESSURE][end] for end in ("low", "top"))
    assert low == -top


def test_a_frame_is_both_runs_at_the_moment(model, run):
    feed = PointFeed(model)
    header, _ = unpacked(feed.field)
    assert set(header["quantities"]) == set(Coloring(model).quantities)
    assert [known["values"] for known in header["known"]] == [
        [case["friction_angle"]] for case in model.simulated
    ]
    _, frame = unpacked(feed.frame(Moment(run, run.steps)))
    np.testing.assert_array_equal(frame["x"], run.positions(run.steps))
    np.testing.assert_allclose(frame["full.x"], model.truth(angle(26.0)).positions(run.steps * run.dt))
    assert frame["moment"][0] == pytest.approx(run.steps * run.dt)
    other = model.start(angle(46.0))
    _, alone = unpacked(feed.frame(Moment(other, 0)))
    assert "full.x" not in alone
    assert other.verdict(other.reached).beyond


@pytest.mark.slow
def test_what_is_said_is_what_is_shown(tilting_model):
    """A run beside it is of the same problem; a hand that tilts gravity makes another."""
    player, feed, (known, *_) = Player(tilting_model), PointFeed(tilting_model), tilting_model.simulated

    def shown():
        while player.work():
            pass
        player.seek(20)
        moment = player.tick()
        return feed.state(moment, player), unpacked(feed.frame(moment))[1]

    player.playing = False
    obey(feed, player, f'{{"values": {list(known.parameters.values())}}}')
    state, frame = shown()
    assert state["known"] == 0
    assert "full.x" in frame
    obey(feed, player, '{"tilt": [5, 0]}')
    state, frame = shown()
    assert state["tilted"]
    assert state["known"] is None
    assert "full.x" not in frame
    obey(feed, player, '{"tilt": null}')
    state, frame = shown()
    assert not state["tilted"]
    assert "full.x" in frame


@pytest.fixture
def address(model):
    yield from threaded(model, feed=PointFeed, rate=10.0)


def opened(browser, url):
    """A window of the page, once it has drawn; requests elsewhere fail the test."""
    window, asked = browser.new_page(viewport={"width": 800, "height": 480}), []
    window.on("request", lambda request: asked.append(request.url))
    window.goto(url)
    wait_until(lambda: window.evaluate("window.nsf && nsf.player.received.frames > 2 && nsf.state.drawn > 2"))
    assert all(one.startswith((url, "data:")) for one in asked)
    return window


def test_in_a_browser(browser, address, model):
    url, player = address
    window = opened(browser, url)
    window.click("#play")
    wait_until(lambda: not player.playing)
    assert window.evaluate("nsf.player.full.visible")
    window.fill("#frame", str(player.steps))
    window.get_by_text("t = 0.12").wait_for()
    wait_until(lambda: window.evaluate("nsf.player.cursor") == player.steps)
    shown = np.reshape(window.evaluate("Array.from(nsf.player.x)"), (-1, 3))
    np.testing.assert_allclose(shown, player.tick().run.positions(player.steps), atol=1e-7)
    before = window.locator("#canvas").screenshot()
    window.get_by_label("sample particles").check()
    wait_until(lambda: window.locator("#canvas").screenshot() != before)
    for color, said in ((PRESSURE, "≤ −"), (SETS, "integration only"), (STRESS, "von Mises")):
        window.select_option("#color", color)
        wait_until(lambda said=said: said in window.text_content("#scale"))
    window.get_by_label("friction angle").fill("46")
    wait_until(lambda: player.tick().run.case == angle(46.0))
    window.get_by_text(re.compile("red: .*outside of 22 … 38")).wait_for()
    window.get_by_text("no full-order run of this case").wait_for()
    assert not window.evaluate("nsf.player.full.visible")
    window.get_by_label("with full-order run").select_option("0")
    window.get_by_text("left: reduced, right: full-order").wait_for()


def test_two_browsers_share_what_is_shown(browser, address):
    url, player = address
    one, other = opened(browser, url), opened(browser, url)
    one.click("#play")
    other.get_by_role("button", name="Play").wait_for()
    other.get_by_label("friction angle").fill("30")
    for window in (one, other):
        window.get_by_text("friction angle = 30.00°").wait_for()
    one.select_option("#color", "displacement")
    wait_until(lambda: other.input_value("#color") == "displacement")
    one.close()
    other.click("#play")
    wait_until(lambda: player.playing)
