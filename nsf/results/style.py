"""How every chart looks, its colours safe for the colour-blind; colour scales; and the files it becomes."""

import io
import itertools
import math
from collections.abc import Collection, Sequence
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure
from PIL import Image

from nsf.results.formats import plain

INK, MUTED, GRID, WARNING = "#222222", "#666666", "#dddddd", "#B04A00"

# Okabe and Ito 2008, without the yellow that vanishes on white; black last.
PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#000000")
DASHES = ("-", (0, (5, 2)), (0, (1.5, 1.5)), (0, (5, 2, 1.5, 2)))

FULL, REDUCED, PAPER = "#7f7f7f", "#0072B2", "#000000"

STAGE_COLORS = {
    "inference": "#0072B2",
    "inversion": "#56B4E9",
    "p2g": "#D55E00",
    "grid": "#E69F00",
    "g2p": "#009E73",
    "stress": "#CC79A7",
    "transfer": "#999999",
}
STAGE_TITLES = {"p2g": "P2G", "g2p": "G2P"}

_RC = {
    "font.family": "DejaVu Sans",
    "font.size": 10,
    "axes.titlesize": 10.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.labelsize": 10,
    "axes.edgecolor": MUTED,
    "axes.labelcolor": INK,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
    "grid.color": GRID,
    "grid.linewidth": 0.7,
    "text.color": INK,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "xtick.labelsize": 9,
    "ytick.labelsize": 9,
    "legend.fontsize": 9,
    "legend.frameon": False,
    "lines.linewidth": 1.6,
    "figure.facecolor": "white",
    "savefig.facecolor": "white",
    "figure.constrained_layout.use": True,
    "figure.constrained_layout.h_pad": 0.06,
    "figure.constrained_layout.w_pad": 0.06,
    "svg.fonttype": "path",
    "svg.hashsalt": "nsf",
    "axes.unicode_minus": True,
    "text.parse_math": False,  # names and titles are no formulas
}

WIDTH = 9.6  # [inch] 960 px at 100 dpi: the width of a report's column
PIXELS = 120  # an inch of a png: sharp at that width, and a report of many pictures stays small
_COLORS = 256
_RAMP = 64  # colours kept of each colour scale: its bar shows no steps
# Of text, and of floors and their shadows, whose soft edges would else become contours.
_GREYS = (*range(34, 195, 17), *range(195, 256, 4))
LETTER = 5.5  # [pt] width of a letter of a legend, or of a number below an axis, about
_ENTRY = 40.0  # [pt] width of what is about a legend's entry
_ROW = 16.5  # [pt] height of a legend's row, about
_CELL = 4  # levels of a channel that Pillow does not tell apart when it looks up a colour


def styled():
    """Context in which figures are made and saved."""
    return rc_context(_RC)


def figure(height: float, width: float = WIDTH) -> Figure:
    """An empty figure [inch] that no pyplot state knows of."""
    return Figure(figsize=(width, height), dpi=100)


def line_style(i: int) -> dict:
    """Colour and dash of the i-th line; dashes change once the colours are used up."""
    return {"color": PALETTE[i % len(PALETTE)], "linestyle": DASHES[i // len(PALETTE) % len(DASHES)]}


def legend_above(fig: Figure, handles: Collection, labels: Collection[str], most: int, **options) -> None:
    """A legend over the panels, in as many columns as fit, `most` at most; options as of `Figure.legend`.

    A legend of more than three rows makes the figure higher, so that panels keep their room.
    """
    columns = int(72.0 * fig.get_figwidth() / (LETTER * max(map(len, labels), default=0) + _ENTRY))
    columns = max(1, min(len(labels), most, columns))
    more = math.ceil(len(labels) / columns) - 3
    fig.set_figheight(fig.get_figheight() + max(more, 0) * _ROW / 72.0)
    legend = fig.legend(handles, labels, loc="outside upper left", ncols=columns, handlelength=2.2, **options)
    legend.get_title().set_fontsize(9)


def stage_colors(stages) -> list[str]:
    """A stage has one colour in every chart; stages not listed take greys."""
    greys = itertools.cycle(("#bbbbbb", "#555555", "#dddddd", "#333333"))
    return [STAGE_COLORS[stage] if stage in STAGE_COLORS else next(greys) for stage in stages]


def save(fig: Figure, folder, stem: str, kinds=("svg", "png"), ramps=()) -> list[str]:
    """Write a figure as `stem.svg` and `stem.png`, without dates, so that equal data gives equal files.

    It is laid out for the png, whose text is a little wider than the svg's.

    Args:
        fig, folder, stem: what is written where.
        kinds: which files.
        ramps: names of the colour scales in it, whose bars show no steps then.
    """
    names = [f"{stem}.{kind}" for kind in kinds]
    with styled():
        for kind in sorted(kinds):
            if kind == "png":
                write_png(fig, folder / f"{stem}.png", PIXELS, ramps)
            else:
                drawn = io.StringIO()
                fig.savefig(drawn, format=kind, dpi=100, metadata={"Date": None})
                text = "\n".join(map(plain, drawn.getvalue().split("\n")))  # XML has no control characters
                (folder / f"{stem}.{kind}").write_text(text, encoding="utf-8")
            fig.set_layout_engine("none")  # the first file has laid it out; that takes as long as drawing
    return names


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
