"""The page of `--html`, in a browser without a network."""

import base64
import io
import re
import zlib
from html import unescape
from pathlib import Path

import numpy as np
import pytest
from packing import unpacked
from PIL import Image

from nsf.errors import ConfigError
from nsf.export import html
from nsf.export.playback import Playback


@pytest.fixture(scope="module")
def page(played, tmp_path_factory) -> Path:
    return html.write(played(every=2), tmp_path_factory.mktemp("page"))


def held(page) -> tuple[dict, dict[str, np.ndarray]]:
    """What a page tells of its run, and its arrays."""
    text = page.read_text(encoding="utf-8")
    return unpacked(zlib.decompress(base64.b64decode(re.search(r'id="data">(.*?)</script>', text)[1])))


def planes(page) -> tuple[np.ndarray, np.ndarray]:
    """Positions [F + 1, N, 3] in 16 bits and stress [F, N] in 8."""
    _, arrays = held(page)
    low, high = arrays["run.x"]
    x = low + 256 * high.astype(np.uint16)
    return x.cumsum(0, dtype=np.uint16), arrays["run.stress"][0].cumsum(0, dtype=np.uint8)


def test_the_page_holds_positions_and_stress(page, played):
    told, _ = held(page)
    x, stress = planes(page)
    lower, upper = (np.array(told["recordings"]["run"][end]) for end in ("lower", "upper"))
    (block,) = played(every=2).blocks()
    x = lower + x / 65535 * (upper - lower)
    np.testing.assert_allclose(x[0], block.X, atol=1e-5)
    np.testing.assert_allclose(x[1:], block.x, atol=1e-5)
    top = told["quantities"]["von_mises"]["top"]
    np.testing.assert_allclose(stress / 255 * top, block.von_mises.clamp(max=top), atol=top / 250)


def test_the_page_is_alone(page):
    text = page.read_text(encoding="utf-8")
    before, _, after = text.partition('id="data"')
    after = after.partition("</script>")[2]
    assert not re.search(r"(src|href)\s*=(?!\"data:,\")|@import|^import|https?://", before + after, re.M)
    policy = unescape(re.search(r'Content-Security-Policy" content="([^"]*)"', text)[1])
    assert policy.startswith("default-src 'none'; script-src 'sha256-")
    assert "unsafe" not in policy
    assert "connect-src" not in policy


def test_a_page_is_small_unless_points_are_asked_for(played, tmp_path, monkeypatch):
    monkeypatch.setattr(html, "POINTS", 100)
    assert held(html.write(played(), tmp_path))[0]["points"] == 100
    assert held(html.write(played(300), tmp_path))[0]["points"] == 300
    monkeypatch.setattr(html, "LARGEST", 1000)
    with pytest.raises(
        ConfigError, match=r"300 points in 6 frames .* give fewer --points or a larger --every"
    ):
        html.write(played(300), tmp_path)


@pytest.mark.parametrize("title", ["</script><b>", "__DATA__", "__TOLD__", "{{ data }}", "a' \"&amp; <!--"])
def test_a_title_is_text_wherever_the_page_holds_it(played, tmp_path, monkeypatch, title):
    monkeypatch.setattr(Playback, "title", title)
    page = html.write(played(10), tmp_path)
    assert held(page)[0]["title"] == title
    assert unescape(re.search(r"<title>([^<]*)</title>", page.read_text())[1]) == title


@pytest.fixture
def opened(browser, page):
    """(address part) → the page, drawn; a fault on it fails the test, as does any request but its own."""
    faults, context = [], browser.new_context(viewport={"width": 600, "height": 420}, offline=True)

    def open_page(part=""):
        tab = context.new_page()
        tab.on("pageerror", lambda error: faults.append(str(error)))
        tab.on("request", lambda request: faults.append(request.url) if "file:" not in request.url else None)
        tab.on(
            "console", lambda m: faults.append(m.text) if m.type == "error" or "INVALID" in m.text else None
        )
        tab.goto(page.as_uri() + part)
        tab.wait_for_selector("body[data-ready=true]", timeout=20000)
        tab.wait_for_selector("body[data-cursor]")
        return tab

    yield open_page
    context.close()
    assert not faults


def drawn(tab) -> np.ndarray:
    """Pixels of the canvas."""
    tab.evaluate("() => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
    picture = Image.open(io.BytesIO(tab.locator("#canvas").screenshot()))
    return np.asarray(picture.convert("RGB")).astype(int)


def differs(one, other) -> float:
    """Share of pixels of another colour."""
    return float((np.abs(one - other).max(2) > 24).mean())


def test_the_browser_unpacks_the_same(opened, page):
    tab = opened()
    found = tab.evaluate("[Array.from(nsf.player.run.planes), Array.from(nsf.player.run.stresses)]")
    for own, packed in zip(found, planes(page), strict=True):
        np.testing.assert_array_equal(own, packed.ravel())


def test_it_plays(opened):
    tab = opened()
    assert tab.title() == "sand, friction angle=26°"
    assert tab.text_content("#play") == "Pause"
    begun = tab.evaluate("document.body.dataset.cursor")
    tab.wait_for_selector(f"body:not([data-cursor='{begun}'])")
    tab.click("#play")
    assert tab.text_content("#play") == "Play"
    stopped = tab.evaluate("document.body.dataset.cursor")
    # What was asked for before the click may reach the screen after it.
    pictures = [drawn(tab) for _ in range(6)]
    assert differs(*pictures[-2:]) == 0
    assert tab.evaluate("document.body.dataset.cursor") == stopped


def test_the_scrubber_and_the_colours_change_what_is_drawn(opened):
    tab = opened("#frame=0")
    before = drawn(tab)
    colored = before[np.ptp(before, axis=2) > 25]
    assert len(colored) > 500
    tab.fill("#frame", "12")
    after = drawn(tab)
    assert tab.evaluate("document.body.dataset.cursor") == "12.00"
    assert "0.120 s" in tab.text_content("#time")
    assert differs(before, after) > 0.01
    tab.select_option("#color", "displacement")
    assert "displacement" in tab.text_content("#scale")
    assert differs(after, drawn(tab)) > 0.005
    tab.check("#cut")
    cut = drawn(tab)
    assert differs(after, cut) > 0.005
    tab.mouse.move(300, 200)
    tab.mouse.down()
    tab.mouse.move(380, 220, steps=3)
    tab.mouse.up()
    assert differs(cut, drawn(tab)) > 0.005


def test_the_address_names_a_frame_and_a_colour(opened):
    tab = opened("#frame=3&color=displacement")
    drawn(tab)
    assert tab.evaluate("document.body.dataset.cursor") == "3.00"
    assert tab.input_value("#color") == "displacement"
