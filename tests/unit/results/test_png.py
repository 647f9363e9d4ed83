"""PNG files with a palette: small, as drawn, and the same bytes for the same figure."""

import matplotlib
import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image

from nsf.results.style import indexed, write_png


@pytest.fixture(scope="module")
def sheet() -> Image.Image:
    """Shaded viridis on white, as particles are, over a grey floor, above a bar of the scale."""
    rng = np.random.default_rng(0)
    pixels = np.full((200, 256, 3), 255, np.uint8)
    pixels[110:170] = 241
    colors = matplotlib.colormaps["viridis"](rng.random((80, 256)))[..., :3]
    pixels[20:100] = (255 * colors * rng.uniform(0.4, 1.0, (80, 256, 1))).astype(np.uint8)
    pixels[180:190] = matplotlib.colormaps["viridis"](np.arange(256), bytes=True)[:, :3]
    return Image.fromarray(pixels)


def apart(a: Image.Image, b: Image.Image) -> np.ndarray:
    """The largest difference of a channel, pixel by pixel."""
    return np.abs(np.asarray(a).astype(int) - np.asarray(b.convert("RGB"))).max(axis=2)


def test_few_colours_are_kept_as_they_are():
    pixels = np.zeros((2, 128, 3), np.uint8)
    pixels[..., 0] = np.arange(256).reshape(2, 128)
    image = Image.fromarray(pixels)
    assert apart(image, indexed(image, ["viridis"])).max() == 0


def test_many_colours_are_near_white_is_white_and_the_bar_has_no_steps(sheet):
    found = indexed(sheet, ["viridis"])
    assert found.mode == "P"
    error = apart(sheet, found)
    white = (np.asarray(sheet) == 255).all(axis=2)
    assert error[white].max() == 0
    assert error[110:170].max() <= 2
    assert error[180:190].max() <= 5
    assert np.percentile(error, 99) <= 20


def test_without_its_scale_the_bar_has_steps(sheet):
    assert apart(sheet, indexed(sheet))[180:190].max() > 5


def test_a_few_pixels_of_a_colour_keep_it(sheet):
    """A line of a chart is a few pixels beside a surface's many."""
    marked = sheet.copy()
    marked.paste((213, 94, 0), (5, 5, 9, 7))
    assert apart(marked, indexed(marked))[5:7, 5:9].max() <= 20


def test_equal_figures_give_equal_bytes_and_half_the_size(sheet, tmp_path):
    figure = Figure(figsize=(2.56, 2.0))
    figure.figimage(np.asarray(sheet))
    for name in ("a.png", "b.png"):
        write_png(figure, tmp_path / name, 100, ["viridis"])
    figure.savefig(tmp_path / "true.png", dpi=100)
    small, again, true = ((tmp_path / name).read_bytes() for name in ("a.png", "b.png", "true.png"))
    assert small == again
    assert len(small) < 0.5 * len(true)
    with Image.open(tmp_path / "a.png") as image:
        assert image.size == (256, 200)
        assert not image.info.keys() & {"Software", "Date", "Creation Time"}
