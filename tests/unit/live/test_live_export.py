"""A model that runs in a page: its numbers beside Python's, and the page in a browser without a network."""

import base64
import json
import re
import shutil
import subprocess
import zlib
from dataclasses import replace
from html import unescape
from pathlib import Path

import numpy as np
import pytest
import torch
from packing import unpacked
from test_player import wait_until

from nsf.cli import main
from nsf.deployment import Rollout, rollout_file
from nsf.errors import ConfigError
from nsf.live import demo, publish
from nsf.live.model import LiveModel
from nsf.live.surface import at_surface, surface
from nsf.storage import write_text

WEB = Path(__file__).parents[1] / "web"


@pytest.fixture(scope="session")
def node():
    """node, which runs the modules of the pages without a browser."""
    path = shutil.which("node")
    if path is None:
        pytest.skip("node is not installed; apt install nodejs")
    return path


@pytest.fixture(scope="session")
def page(taught_model, tmp_path_factory):
    """The page of the tiny chain by a recurrence, all of its particles in it."""
    return publish.write(taught_model.run, tmp_path_factory.mktemp("live"), device="cpu")


@pytest.fixture(scope="session")
def tilting_page(chromium, tilting_model, tmp_path_factory):
    """The page of a tiny block under programs of gravity, made where a browser can show it."""
    return publish.write(tilting_model.run, tmp_path_factory.mktemp("tilting"), device="cpu")


@pytest.fixture(scope="session")
def whole(page, node):
    """Every held-out case to its end, as node takes it."""
    done = subprocess.run([node, WEB / "whole.mjs", page], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)["found"]


def test_the_modules_under_node(node):
    done = subprocess.run([node, "--test", WEB], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stdout
    assert "# pass 0" not in done.stdout


def test_a_whole_run_is_pythons(whole, taught_model):
    cases = taught_model.pipeline.held_out
    assert len(cases) == len(whole) == 3
    at = taught_model.manifold.restrict(torch.as_tensor(taught_model.shown))
    for index, found in enumerate(whole):
        kept = Rollout.open(taught_model.run.file(rollout_file(index)))
        assert found["steps"] == len(kept.xhat) - 1
        np.testing.assert_allclose(found["xhat"], kept.xhat[-1], rtol=0, atol=1e-4 * np.abs(kept.xhat).max())
        xhat = torch.as_tensor(kept.xhat[-1])
        x = at.position(xhat).numpy()
        moved = np.abs(x - taught_model.manifold.X[taught_model.shown].numpy()).max()
        assert moved > taught_model.pipeline.scene.dx  # or nearness would mean nothing
        off = np.reshape(found["x"], (-1, 3)) - x
        assert np.abs(off).max() < 1e-3 * taught_model.pipeline.scene.dx
        tau = at.stress(xhat, torch.as_tensor([cases[index]["friction_angle"]])).numpy()
        assert np.abs(np.reshape(found["tau"], (-1, 6)) - tau).max() < 0.02 * np.abs(tau).max()


def test_lights_are_pythons(whole, taught_model):
    for index, run in enumerate(whole):
        verdict = Rollout.open(taught_model.run.file(rollout_file(index))).verdict
        assert run["light"]["level"] == verdict.flag
        assert run["light"]["text"].split(";")[-1] == verdict.text.split(";")[-1]


def test_most_of_few_points_lie_at_the_surface(chain):
    X = chain.scene.particles().X
    outer = at_surface(X)
    assert 0.2 < outer.mean() < 0.9
    middle = 0.5 * (X.min(0) + X.max(0))
    depth = np.linalg.norm((X - middle)[:, :2], axis=1) / np.ptp(X[:, 0])
    assert depth[outer].mean() > depth[~outer].mean()
    model = LiveModel(chain.pipeline.deployment, points=100, device="cpu", surface=True)
    assert len(model.shown) == len(np.unique(model.shown)) == 100
    assert outer[model.shown].mean() > outer.mean()
    assert set(model.sample) <= set(model.shown)


def test_a_run_that_no_recurrence_takes_is_refused(model, tmp_path, monkeypatch):
    with pytest.raises(
        ConfigError, match=r"model=projected, whose steps a page does not take.* model=recurrence"
    ):
        publish.model_data(model)
    monkeypatch.setattr(publish, "LiveModel", None)  # which takes minutes of a large run
    with pytest.raises(
        ConfigError, match=r"model=projected, whose steps a page does not take.* model=recurrence"
    ):
        publish.write(model.run, tmp_path, device="cpu")


def test_options_of_other_formats_are_refused(capsys):
    with pytest.raises(SystemExit) as end:
        main(["export", "sand", "--live", "--parameter", "26", "--every", "2"])
    assert end.value.code == 2
    assert "page shows as its reader asks; leave out --parameter, --every" in capsys.readouterr().err


def test_a_page_that_is_too_large_is_refused(taught_model, tmp_path, monkeypatch):
    monkeypatch.setattr(publish, "LARGEST", 1000)
    with pytest.raises(ConfigError, match=r"would have \d.* MB, at most 0; give fewer --points"):
        publish.write(taught_model.run, tmp_path, device="cpu")
    assert not list(tmp_path.iterdir())


def test_a_model_is_there_at_once(capsys, tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr("webbrowser.open", asked.append)
    for model in demo.MODELS:
        path = demo.show(model, tmp_path)
        assert demo.MODELS[model] in path.read_text()
    assert asked == [(tmp_path / f"{model}.html").as_uri() for model in demo.MODELS]
    with pytest.raises(
        ConfigError, match="model=cake is none that is shipped; choose one of block, tray, metal"
    ):
        demo.show("cake", tmp_path)
    with pytest.raises(SystemExit) as end:
        main(["demo", "model=tray", f"folder={tmp_path}", "open=false"])
    assert not end.value.code
    assert capsys.readouterr().out == f"open {tmp_path / 'tray.html'}\n"
    assert len(asked) == len(demo.MODELS)


def test_a_model_that_is_shipped_is_small():
    found = [path.stat().st_size for path in Path(demo.__file__).with_name("models").iterdir()]
    assert len(found) == len(demo.MODELS)
    assert sum(found) < 9e6


def test_a_shipped_model_begins_with_a_case_that_is_believed():
    for model in demo.MODELS:
        data = Path(demo.__file__).with_name("models") / f"{model}.bin"
        header, arrays = unpacked(zlib.decompress(data.read_bytes()))
        assert header["trust"]["calibration"] is not None
        assert header["cases"][header["first"]]["recording"] is not None
        assert ("faces" in arrays) == (model != "tray")  # sand is grains


def test_a_surface_closes_a_body_and_faces_outward():
    generator = np.random.default_rng(0)
    X = generator.random((2000, 3))
    still = np.stack([X, 1.5 * X])
    rows, faces = surface(X, 2000 ** (-1 / 3), still).values()
    corners = X[rows][faces]
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    assert set(np.unique(edges, axis=0, return_counts=True)[1]) <= {2, 4}
    volume = np.linalg.det(corners).sum() / 6
    assert 0.75 < volume < 1.0
    torn = still[1] + (X[:, :1] > 0.5) * np.array([2.0, 0.0, 0.0])
    assert surface(X, 2000 ** (-1 / 3), np.stack([X, torn])) == {}
    assert surface(X[:4], 1.0, still[:, :4]) == {}


def test_a_page_is_asked_for_as_other_formats_are(taught_model, tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("NSF_RUNS", str(taught_model.run.root))
    given = [taught_model.run.id, "--live", "--points", "150", "--device", "cpu", "--output", str(tmp_path)]
    with pytest.raises(SystemExit) as end:
        main(["export", *given])
    assert not end.value.code
    assert f"live → {tmp_path / 'sand-live.html'}" in capsys.readouterr().out
    text = re.search(r'id="data">([^<]*)<', (tmp_path / "sand-live.html").read_text())[1]
    header, arrays = unpacked(zlib.decompress(base64.b64decode(text)))
    assert header["points"] == len(arrays["rest"]) == 150


# -- in a browser -------------------------------------------------------------------------------------------


@pytest.fixture
def opened(browser):
    """(page, size, dark) → a tab of it without a network; a fault or a request fails the test."""
    faults = []

    def open_page(page, width=800, height=480, **options):
        context = browser.new_context(viewport={"width": width, "height": height}, offline=True, **options)
        tab = context.new_page()
        tab.on("pageerror", lambda error: faults.append(str(error)))
        tab.on(
            "request", lambda r: faults.append(r.url) if not r.url.startswith(("file:", "data:")) else None
        )
        tab.on("console", lambda m: faults.append(m.text))
        tab.goto(page.as_uri())
        tab.wait_for_selector("body[data-ready=true]", timeout=60_000)
        wait_until(lambda: tab.evaluate("nsf.state.drawn > 1"))
        return tab

    yield open_page
    assert not faults


def paused(tab, step=0):
    """Pause, and show a step."""
    if tab.text_content("#play") == "Pause":
        tab.click("#play")
    tab.evaluate(f"nsf.player.seek({step}); nsf.state.changed = true")
    wait_until(lambda: tab.evaluate("!nsf.state.changed"))


def positions(tab) -> np.ndarray:
    return np.reshape(tab.evaluate("Array.from(nsf.player.deformation.values)"), (-1, 3))


def test_it_plays_from_disk_without_a_network(opened, page):
    tab = opened(page)
    begun = tab.evaluate("document.body.dataset.cursor")
    tab.wait_for_selector(f"body:not([data-cursor='{begun}'])")
    assert tab.title() == "Sand column"
    tab.click("#play")
    assert tab.text_content("#play") == "Play"
    tab.click("#reset")
    tab.click("#step")
    assert tab.evaluate("nsf.player.cursor") == 1
    tab.locator("#title").click()
    tab.keyboard.press("ArrowRight")
    assert tab.evaluate("nsf.player.cursor") == 2
    tab.keyboard.press(" ")
    assert tab.text_content("#play") == "Pause"


def test_a_slider_changes_the_run_and_the_light(opened, page, taught_model):
    tab = opened(page)
    paused(tab, 24)
    before, picture = positions(tab), tab.locator("#canvas").screenshot()
    tab.get_by_label("friction angle").fill("36")
    wait_until(lambda: np.abs(positions(tab) - before).max() > 1e-4)
    assert tab.locator("#canvas").screenshot() != picture
    assert tab.evaluate("nsf.player.run.steps") == 24
    assert "45" not in tab.text_content("#light")
    tab.get_by_label("friction angle").fill("45")
    tab.get_by_text("friction angle=45° is outside of 22 … 38").wait_for()
    tab.select_option("#from", "here")
    paused(tab, 10)
    latents = tab.evaluate("nsf.player.run.latents.slice(0, 11).map((x) => Array.from(x))")
    tab.get_by_label("friction angle").fill("30")
    tab.click("#step")
    assert tab.evaluate("nsf.player.run.latents.slice(0, 11).map((x) => Array.from(x))") == latents


@pytest.mark.slow
def test_a_drag_tilts_gravity_and_the_body_follows(opened, tilting_page):
    tab = opened(tilting_page, 1000, 700)  # with the whole pad in sight
    paused(tab, 0)
    box = tab.locator("#pad").bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    right = np.array(tab.evaluate("nsf.camera.axes.right"))
    aside = []
    for way in (0.3, -0.3):
        tab.click("#reset")
        paused(tab, 0)
        tab.mouse.move(x, y)
        tab.mouse.down()
        tab.mouse.move(x + way * box["width"], y, steps=3)
        tab.mouse.up()
        assert tab.text_content("#play") == "Pause"  # a hand sets it going
        gravity = np.array(tab.evaluate("nsf.player.run.hand"))
        assert np.linalg.norm(gravity) == pytest.approx(9.81)
        assert np.sign(gravity @ right) == np.sign(way)
        paused(tab, 60)
        aside.append((positions(tab) @ right).mean())
    assert aside[0] - aside[1] > 0.01
    tab.click("#upright")
    assert tab.evaluate("nsf.player.run.hand") is None
    tab.locator("#pad").focus()
    for _ in range(10):
        tab.keyboard.press("ArrowLeft")
    assert np.array(tab.evaluate("nsf.player.run.hand")) @ right < -1.0
    for _ in range(6):  # past the end of a stride, which is judged as a whole
        tab.click("#step")
    tab.get_by_text("which was taught").wait_for()


@pytest.mark.slow
def test_a_drag_on_the_picture_turns_it_or_tilts(opened, tilting_page):
    tab = opened(tilting_page)

    def drag():
        tab.mouse.move(300, 300)
        tab.mouse.down()
        tab.mouse.move(380, 300, steps=3)
        tab.mouse.up()
        return tab.evaluate("[nsf.camera.azimuth, nsf.player.run.hand]")

    first = tab.evaluate("nsf.camera.azimuth")
    azimuth, hand = drag()
    assert azimuth != first
    assert hand is None
    tab.get_by_label("a drag on the picture tilts").check()
    again, hand = drag()
    assert again == azimuth
    assert hand is not None


@pytest.mark.slow
def test_a_program_of_each_held_out_case_is_followed(opened, tilting_page, tilting_model):
    tab = opened(tilting_page)
    for index, case in enumerate(tilting_model.pipeline.held_out):
        tab.select_option("#case", str(index))
        paused(tab, 60)
        kept = Rollout.open(tilting_model.run.file(rollout_file(index))).xhat
        found = tab.evaluate("Array.from(nsf.player.run.latents[60])")
        np.testing.assert_allclose(found, kept[60], atol=1e-4 * np.abs(kept).max())
        scene = tilting_model.pipeline.deployed.at(case)
        gravity = tab.evaluate("nsf.player.run.gravities[40]")
        np.testing.assert_allclose(gravity, scene.acting_gravity.at(40 * scene.dt), atol=1e-9)


def test_only_programs_of_gravity_are_tilted_by_hand(opened, page):
    """A manifold of upright sand alone knows no shape that leans."""
    assert opened(page).locator("#pad").count() == 0


def test_the_full_order_run_stands_beside(opened, page):
    tab = opened(page)
    paused(tab, 24)
    before = tab.locator("#canvas").screenshot()
    tab.get_by_label("full-order run beside it").check()
    wait_until(lambda: tab.locator("#canvas").screenshot() != before)
    shown = "nsf.player.recordings.get(nsf.player.case.recording)"
    full = np.reshape(tab.evaluate(f"Array.from({shown}.at({shown}.frameAt(0.12)).x)"), (-1, 3))
    corners = tab.evaluate("Array.from(nsf.player.arrays.corners)")
    assert np.abs(full - positions(tab)[corners]).max() < 0.02
    tab.get_by_label("friction angle").fill("31")
    tab.get_by_text("No full-order run of this was stored").wait_for()


def test_what_it_keeps_is_the_picture_and_the_run(opened, page):
    tab = opened(page)
    paused(tab, 24)
    with tab.expect_download() as kept:
        tab.click("#table")
    lines = Path(kept.value.path()).read_text().splitlines()
    assert lines[0].startswith('"t [s]","xhat_0"')
    rows = np.array([list(map(float, line.split(","))) for line in lines[1:]])
    assert rows.shape == (25, 1 + 4 + 3 + 1)
    np.testing.assert_allclose(rows[-1, 1:5], tab.evaluate("Array.from(nsf.player.run.latents[24])"))
    with tab.expect_download() as kept:
        tab.click("#picture")
    assert Path(kept.value.path()).read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
@pytest.mark.parametrize(("width", "height"), [(800, 480), (390, 844), (1280, 800)])
def test_the_pad_is_in_sight_and_the_scene_within_the_picture(opened, tilting_page, width, height):
    tab = opened(tilting_page, width, height)
    box = tab.locator("#pad").bounding_box()
    assert box["y"] >= 0
    assert box["y"] + box["height"] <= height
    assert tab.locator("#scale span").count() >= 4
    corners = """() => { const { camera, drawing: { canvas } } = nsf, { lower, upper } = camera;
        const m = camera.view(canvas.width / canvas.height);
        return [0, 1, 2, 3, 4, 5, 6, 7].flatMap((k) => {
            const x = [0, 1, 2].map((c) => ((k >> c) & 1 ? upper : lower)[c]);
            const row = (r) => m[r] * x[0] + m[4 + r] * x[1] + m[8 + r] * x[2] + m[12 + r];
            return [row(0) / row(3), row(1) / row(3)]; }); }"""
    reach = np.abs(tab.evaluate(corners)).max()
    assert 0.8 < reach < 1.0


def test_on_a_phone_in_the_dark(opened, page):
    tab = opened(page, 390, 800, color_scheme="dark", has_touch=True, is_mobile=True)
    assert tab.evaluate("document.documentElement.scrollWidth") <= 390
    assert tab.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(22, 24, 27)"
    assert tab.locator("#canvas").bounding_box()["height"] > 250


@pytest.mark.slow
def test_a_phone_may_tilt_it(opened, tilting_page):
    tab = opened(tilting_page, 390, 800, has_touch=True, is_mobile=True)
    tab.evaluate("() => { DeviceOrientationEvent.requestPermission = async () => 'denied'; }")
    tab.get_by_role("button", name="Use this device's tilt").click()
    tab.get_by_role("button", name="This device keeps its tilt to itself").wait_for()
    tab.evaluate("() => { DeviceOrientationEvent.requestPermission = async () => 'granted'; }")
    tab.click("#device")
    turn = "(gamma) => dispatchEvent(new DeviceOrientationEvent('deviceorientation', {beta: 40, gamma}))"
    for gamma in (0, 20):
        tab.evaluate(turn, gamma)
        wait_until(lambda: tab.evaluate("nsf.player.run.hand !== null"))
    right = np.array(tab.evaluate("nsf.camera.axes.right"))
    hand = np.array(tab.evaluate("nsf.player.run.hand"))
    assert hand @ right == pytest.approx(9.81 * np.sin(np.radians(20)), rel=1e-3)


def test_without_webgl_it_says_so(browser, page):
    context = browser.new_context(offline=True)
    tab = context.new_page()
    tab.add_init_script("HTMLCanvasElement.prototype.getContext = () => null")
    tab.goto(page.as_uri())
    tab.get_by_text("This browser has no WebGL 2").wait_for()


def test_every_control_has_a_name(opened, page):
    tab = opened(page)
    nameless = """() => [...document.querySelectorAll("input, select, button, canvas, [tabindex]")]
        .filter((e) => ![e.ariaLabel, e.getAttribute("aria-label"), e.textContent, e.labels?.[0]?.textContent]
            .some((name) => name?.trim()))
        .map((e) => e.outerHTML)"""
    assert tab.evaluate(nameless) == []


def test_titles_units_and_names_are_text(opened, taught_model, tmp_path, monkeypatch):
    hostile = "</script><script>alert(1)</script><img src=x onerror=alert(1)>a\"'&amp;"

    monkeypatch.setattr(taught_model, "title", hostile)
    parameters = tuple(replace(p, unit=hostile) for p in taught_model.parameters)
    monkeypatch.setattr(taught_model, "parameters", parameters)
    title, data = publish.model_data(taught_model)
    path = write_text(tmp_path / "page.html", publish.page.html(title, data))
    assert unescape(re.search(r"<title>([^<]*)</title>", path.read_text())[1]) == hostile
    tab = opened(path)
    assert tab.text_content("#title") == tab.title() == hostile
    assert hostile in tab.text_content("#panel")
    assert tab.locator("img").count() == 0
