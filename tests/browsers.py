"""A headless Chromium with software WebGL."""

from contextlib import contextmanager


@contextmanager
def launched(path):
    """A browser; while it is open its thread has a running event loop, which `asyncio.run` refuses."""
    from playwright.sync_api import sync_playwright

    software = ["--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
    with sync_playwright() as started:
        browser = started.chromium.launch(executable_path=path, args=["--no-sandbox", *software])
        yield browser
        browser.close()
