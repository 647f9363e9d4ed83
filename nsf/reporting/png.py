"""PNG files of at most 256 colours, a third of the size of true colour; equal figures give equal bytes."""

import io
from collections.abc import Sequence
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from PIL import Image

_COLORS = 256
_RAMP = 64  # colours kept of each colour scale: its bar shows no steps
# Of text, and of floors and their shadows, whose soft edges would else become contours.
_GREYS = (*range(34, 195, 17), *range(195, 256, 4))
_CELL = 4  # levels of a channel that Pillow does not tell apart when it looks up a colour


def write_png(fig: Figure, path: Path, dpi: float, ramps: Sequence[str] = ()) -> None:
    """Write a figure without a date, in its own colours where these are few, else in those nearest to them.

    Args:
        fig: the figure; its background is white.
        path: of the file.
        dpi: pixels an inch.
        ramps: names of the colour scales in it, of matplotlib.
    """
    drawn = io.BytesIO()
    fig.savefig(drawn, format="png", dpi=dpi)
    with Image.open(drawn) as image:
        indexed(image.convert("RGB"), ramps).save(path, "PNG", optimize=True)


def indexed(image: Image.Image, ramps: Sequence[str] = ()) -> Image.Image:
    """An RGB image with a palette; exact where it has no more than 256 colours."""
    if image.getcolors(_COLORS) is not None:
        return image.quantize(_COLORS, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
    kept = [_ramp(name) for name in ramps]
    if kept:
        kept.append(np.repeat(np.array([_GREYS]).T, 3, axis=1))
    # With two bits less a channel it takes a sixth of the time. By the span of colours and not by their
    # pixels: the few of a thin line count as much as those of a surface.
    coarse = image.point(lambda value: value - value % _CELL + value // 64)
    count = _COLORS - sum(map(len, kept))
    adapted = coarse.quantize(count, Image.Quantize.MAXCOVERAGE, kmeans=1, dither=Image.Dither.NONE)
    if not kept:
        return adapted
    colors = np.concatenate([*kept, np.array(adapted.getpalette()).reshape(-1, 3)])
    lookup = Image.new("P", (1, 1))
    # Pillow compares the lowest colour of a cell: unshifted, white would become the grey below it.
    lookup.putpalette(np.maximum(colors - _CELL // 2, 0).ravel().tolist())
    found = image.quantize(palette=lookup, dither=Image.Dither.NONE)
    found.putpalette(colors.ravel().tolist())
    return found


def _ramp(name: str) -> np.ndarray:
    """Colours [_RAMP, 3] from one end of a scale to the other, in 8 bits."""
    return matplotlib.colormaps[name](np.linspace(0, 1, _RAMP), bytes=True)[:, :3].astype(int)
