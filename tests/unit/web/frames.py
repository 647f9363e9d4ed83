"""Pictures a second of a page of 20 000 points in Chromium with software drawing.

`python tests/unit/web/frames.py` prints them, and the processor time that each takes. The points are those of
the shipped sand column, each many times over, beside one another.
"""

import os
import re
import shutil
import sys
import tempfile
import zlib
from importlib.resources import files
from pathlib import Path

import numpy as np
from playwright.sync_api import sync_playwright

sys.path.insert(0, str(Path(__file__).parents[2]))
from packing import unpacked

from nsf.live import page

POINTS, SECONDS, SIZE = 20_000, 8, {"width": 1280, "height": 800}
SOFTWARE = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
#: From a moved slider until the picture of the new run is drawn to its last pixel [ms].
FOLLOWED = """async (value) => {
    const slider = document.querySelector(".slider input"), gl = nsf.drawing.gl, pixel = new Uint8Array(4);
    const began = performance.now(), drawn = nsf.state.drawn;
    slider.value = value;
    slider.oninput();
    while (nsf.state.drawn === drawn) await new Promise(requestAnimationFrame);
    gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, pixel);
    return performance.now() - began;
}"""
#: Pictures a second that the browser composed, and seconds of JavaScript in the newest.
PLAYED = """async (seconds) => {
    const [began, drawn] = [performance.now(), nsf.state.drawn];
    await new Promise((done) => setTimeout(done, 1000 * seconds));
    return [(1000 * (nsf.state.drawn - drawn)) / (performance.now() - began), 1000 * nsf.state.seconds];
}"""


def sand_page(folder: Path) -> Path:
    """The sand column's page with its points many times over."""
    header, arrays = unpacked(
        zlib.decompress(files("nsf").joinpath("live", "models", "sand.bin").read_bytes())
    )
    had = header["points"]
    rows = np.arange(POINTS) % had
    for name in ("rest", "deformation.mean", "deformation.modes", "stress.mean", "stress.modes"):
        arrays[name] = arrays[name][rows]
    aside = np.random.default_rng(0).uniform(-1, 1, (POINTS, 3)).astype("f4") * header["radius"]
    for name in ("rest", "deformation.mean"):
        arrays[name] = arrays[name] + aside
    header |= {"points": POINTS, "radius": header["radius"] * (had / POINTS) ** (1 / 3)}
    return page.saved(folder / "page.html", page.html(header["title"], page.packed(header, arrays)))


def processor_time() -> dict[str, float]:
    """Seconds of processor time that a browser's processes have taken, by what they do."""
    found: dict[str, float] = {}
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            told, stat = (folder / "cmdline").read_bytes(), (folder / "stat").read_text()
        except OSError:
            continue
        if kind := re.search(rb"--type=([a-z-]+)", told):
            name, ticks = kind[1].decode(), sum(map(int, stat.rpartition(")")[2].split()[11:13]))
            found[name] = found.get(name, 0.0) + ticks / os.sysconf("SC_CLK_TCK")
    return found


def measured(tab) -> None:
    """Print what a tab does in a while."""
    for when in ("at first", "later"):
        before = processor_time()
        pictures, script = tab.evaluate(PLAYED, SECONDS)
        taken = {kind: now - before.get(kind, 0.0) for kind, now in processor_time().items()}
        each = {kind: 1000 * seconds / (pictures * SECONDS) for kind, seconds in taken.items()}
        told = ", ".join(f"{kind} {time:.0f}" for kind, time in each.items() if time >= 1)
        print(f"{when}: {pictures:.1f} pictures/s; ms of processor time each: {told}; script {script:.1f}")
    for how, step in (("playing", None), ("standing", 60)):
        if step is not None:
            tab.click("#play")
            tab.evaluate(f"nsf.player.seek({step})")
            tab.wait_for_timeout(2000)
        times = []
        for value in np.linspace(22, 38, 9):
            times.append(tab.evaluate(FOLLOWED, float(value)))
            tab.wait_for_timeout(100 if len(times) % 3 else 1500)
        told = ", ".join(f"{t:.0f}" for t in times)
        print(f"slider to picture, {how}: median {np.median(times):.0f} ms; {told}")


def main() -> None:
    """Measure."""
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as started:
        chromium = started.chromium.launch(executable_path=shutil.which("chromium"), args=SOFTWARE)
        tab = chromium.new_page(viewport=SIZE)
        tab.goto(sand_page(Path(folder)).as_uri())
        tab.wait_for_selector("body[data-ready=true]", timeout=60_000)
        measured(tab)
        chromium.close()


if __name__ == "__main__":
    main()
