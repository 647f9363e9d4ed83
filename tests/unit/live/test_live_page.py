"""`nsf view` in a real browser, without a network."""

import io
import re
import socket
import threading
import time
import urllib.request

import numpy as np
import pytest
from test_player import wait_until

pytest.importorskip("viser", reason="viser is not installed")

from angles import angle
from PIL import Image

from nsf.live.coloring import Coloring
from nsf.live.page import Page, legend, light
from nsf.live.player import Moment, Player

PATIENCE = 120_000  # [ms] after which something is broken, however busy the machine is
#: What a client draws is behind its canvas, above which the panel lies.
SCENE = {"x": 0, "y": 120, "width": 700, "height": 480}


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
    for by in coloring.scales:
        for step in (0, run.steps):
            for beside in (truth, None):
                picture = coloring.picture(Moment(run, step), beside, by)
                assert picture.x_reduced.shape == picture.colors_reduced.shape == (200, 3)
                assert picture.colors_reduced.dtype == np.uint8
                assert (picture.x_full is None) == (picture.colors_full is None) == (beside is None)


def test_colours_say_what_they_are_of(model, coloring, run):
    def colors(by, step=run.steps):
        return coloring.picture(Moment(run, step), model.truth(angle(26.0)), by)

    lowest = coloring.scales["displacement"].pixels(np.zeros(1)).astype(int)
    # In double precision nothing has moved at t = 0; the page shows float32.
    assert abs(colors("displacement", 0).colors_reduced.astype(int) - lowest).max() <= 1
    assert len(np.unique(colors("displacement").colors_reduced, axis=0)) > 20
    assert len(np.unique(colors("distance to the truth").colors_full, axis=0)) == 1
    assert len(np.unique(colors("distance to the truth").colors_reduced, axis=0)) > 5
    unknown = coloring.picture(Moment(run, run.steps), None, "distance to the truth").colors_reduced
    assert (unknown == 0xBB).all()  # a grey that is not on the scale, where no distance is "small"
    sample = colors("particle sets").colors_reduced[model.roles(0) == 2]
    assert len(np.unique(sample, axis=0)) == 1
    assert not np.array_equal(colors("pressure").colors_full, colors("von Mises stress").colors_full)


def test_the_light(model, run):
    inside = Moment(run, run.steps)
    assert inside.trust < 1.0
    assert "below 1" in light(inside)
    beyond = model.start(angle(46.0))
    assert "away from the training cases: ratio 2, above 1" in light(Moment(beyond, 0))
    beyond._ratios[0] = 2.5
    assert "distrusted: ratio 2.5" in light(Moment(beyond, 0))
    lost = model.start(angle(26.0))
    lost._solver.xhat[0] = 1e4
    lost.advance(lost.steps)
    assert "diverged at t = " in light(Moment(lost, lost.reached))


def test_the_legend_names_its_ends(coloring):
    stress = legend(coloring.scales["von Mises stress"], "von Mises stress")
    assert re.search(r"<span>0</span><span>von Mises stress \[\w*Pa\]</span>", stress)
    assert re.search(r"<span>-[\d.]+</span><span>pressure", legend(coloring.scales["pressure"], "pressure"))
    assert "integration only" in legend(None, "particle sets")


@pytest.fixture
def served(model, monkeypatch):
    """A page that is drawn, and its player."""
    # Two browsers that draw in software cannot follow 30 pictures a second on a busy machine: what they had
    # yet to draw would stand in front of what a test waits for.
    monkeypatch.setattr("nsf.live.page.FRAMES_PER_SECOND", 4)
    player = Player(model)
    page, closing = Page(player, port=0), threading.Event()
    drawing = threading.Thread(target=page.run, args=(closing,))
    with player:
        drawing.start()
        yield page, player
        closing.set()
        drawing.join()
        page.close()


def opened(browser, url):
    """A window of the page, and the addresses it asked for."""
    window, asked = browser.new_page(viewport={"width": 1100, "height": 640}), []
    window.set_default_timeout(PATIENCE)
    window.on("request", lambda request: asked.append(request.url))
    window.goto(url)
    window.get_by_role("slider").first.wait_for()
    return window, asked


def samples(window) -> int:
    """Pixels in the colour of sample particles.

    No picture is compared with another: viser draws fewer pixels where it is slow.
    """
    with Image.open(io.BytesIO(window.screenshot(clip=SCENE))) as picture:
        red, green, blue = np.asarray(picture.convert("RGB")).astype(int).reshape(-1, 3).T
    return int(((red > 150) & (abs(green - 95) < 45) & (blue < 60)).sum())


def test_in_a_browser(browser, served):
    page, player = served
    window, asked = opened(browser, page.url)
    assert not [
        u for u in asked if not u.startswith((page.url, "data:", "blob:", page.url.replace("http", "ws")))
    ]
    window.get_by_role("button", name="pause").click()
    window.get_by_role("button", name="play", exact=True).wait_for()
    player.seek(player.steps)
    wait_until(lambda: player.tick().run.finished)
    window.get_by_text("t = 0.12 s").wait_for()
    before = samples(window)
    window.get_by_label("sample particles").check()
    wait_until(lambda: samples(window) > before + 50)
    most = samples(window)
    window.get_by_label("sample particles").uncheck()
    wait_until(lambda: samples(window) <= max(before + 10, most // 2))

    shown = window.screenshot(clip=SCENE)
    number = window.get_by_role("textbox").first
    number.fill("46")
    number.press("Enter")
    wait_until(lambda: player.tick().run.case == angle(46.0))
    window.get_by_text(re.compile("away from the training cases|distrusted")).wait_for()
    window.get_by_text("no full-order run of this case").wait_for()
    page._by.value = "distance to the truth"
    window.get_by_text("grey: unknown").wait_for()
    wait_until(lambda: window.screenshot(clip=SCENE) != shown)


def test_what_is_displayed_is_what_is_labelled(tilting_model):
    """Controls name the case and the gravity that are shown; a run beside it is of the same problem."""
    player = Player(tilting_model)
    page, (known, *_) = Page(player, port=0), tilting_model.known

    def shown():
        while player.work():
            pass
        player.seek(20)
        page.draw()
        return page._told.content

    try:
        player.playing = False
        player.steer(list(known.parameters.values()))
        assert "no full-order run" not in shown()
        assert page._full.visible
        assert page._known.value == str(known)
        page._tilts[0].value = 5.0
        page._tilt()
        assert "gravity tilted by hand" in shown()
        assert "no full-order run of this program" in page._told.content
        assert not page._full.visible
        assert page._known.value == "…"
        page._known.value = str(known)
        page._go_to()  # the same case: the hand lets go
        assert "tilted by hand" not in shown()
        assert page._tilts[0].value == 0.0
        assert page._full.visible
        values = list(known.parameters.values())
        for slider, value, p in zip(page._sliders, values, tilting_model.parameters, strict=True):
            slider.value = value + 0.3 * p.step
        page._steer()
        shown()
        assert [slider.value for slider in page._sliders] == values
        page._cut.value = True
        drawn = int(page._behind.sum())
        assert 0 < drawn < len(tilting_model.shown)
        assert f"{drawn:,} of {tilting_model.particles:,} particles" in shown()
    finally:
        page.close()


def test_two_browsers_share_what_is_shown(browser, served):
    page, player = served
    (one, _), (other, _) = opened(browser, page.url), opened(browser, page.url)
    one.get_by_role("button", name="pause").click()
    other.get_by_role("button", name="play", exact=True).wait_for()
    player.seek(player.steps)
    before = [window.screenshot(clip=SCENE) for window in (one, other)]
    number, asked = other.get_by_role("textbox").first, "friction angle=30°, t = 0.12 s"

    def typed() -> bool:
        """What the page says of the seek may come while one types, and take the place of what was typed."""
        number.fill("30")
        number.press("Enter")
        until = time.monotonic() + 20.0
        while time.monotonic() < until and not other.get_by_text(asked).count():
            other.wait_for_timeout(100)
        return bool(other.get_by_text(asked).count())

    wait_until(typed)
    for window, shown in zip((one, other), before, strict=True):
        window.get_by_text(asked).wait_for()
        wait_until(lambda window=window, shown=shown: window.screenshot(clip=SCENE) != shown)
    one.close()
    drawn = page.drawn
    player.playing = True
    wait_until(lambda: page.drawn > drawn + 5)
    assert other.get_by_role("slider").count() == 2


def test_a_page_of_another_site_neither_sees_nor_steers(player):
    """viser lets every origin in; the server here does not, nor another name for this machine."""
    from websockets.exceptions import InvalidStatus
    from websockets.sync.client import connect

    page = Page(player, port=0)
    try:
        port = int(page.url.rsplit(":", 1)[1])

        def status(origin=None, host=f"127.0.0.1:{port}"):
            try:
                with connect(
                    f"ws://{host}", origin=origin, sock=socket.create_connection(("127.0.0.1", port))
                ):
                    return 101
            except InvalidStatus as error:
                return error.response.status_code

        assert status() == status(f"http://127.0.0.1:{port}") == 101
        assert status("http://evil.example") == status("null") == status("http://127.0.0.1:1") == 403
        assert status(f"http://evil.example:{port}", f"evil.example:{port}") == 403
        with urllib.request.urlopen(page.url, timeout=20) as response:
            assert response.status == 200
    finally:
        page.close()


def test_no_client_opens_a_tunnel_to_the_internet(player, monkeypatch):
    """viser would, on a message that any client may send."""
    import viser

    asked = []
    monkeypatch.setattr(viser._viser, "ViserTunnel", lambda *a, **k: asked.append(a))
    page = Page(player, port=0)
    try:
        assert page._server.request_share_url() is None
        assert not asked
    finally:
        page.close()
