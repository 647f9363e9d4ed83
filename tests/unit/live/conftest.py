"""The tiny chain's deployment, run live."""

import shutil

import pytest

from nsf.live.model import LiveModel
from nsf.live.player import Player


@pytest.fixture(scope="session")
def model(chain):
    """The live model; runs hold all that changes, so tests share it."""
    return LiveModel(chain.pipeline.deployment, points=200, device="cpu")


@pytest.fixture
def player(model):
    """A player whose worker is not started: tests do its work."""
    return Player(model)


@pytest.fixture
def browser():
    """A headless Chromium with software WebGL."""
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    path = shutil.which("chromium") or shutil.which("google-chrome")
    if path is None:
        pytest.skip("there is no Chromium on the PATH")
    software = ["--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
    with playwright.sync_playwright() as started:
        chromium = started.chromium.launch(executable_path=path, args=["--no-sandbox", *software])
        yield chromium
        chromium.close()
