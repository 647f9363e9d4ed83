"""How every chart looks: colours safe for the colour-blind, one font size scale, no ornament."""

import itertools

from matplotlib import rc_context
from matplotlib.figure import Figure

from nsf.reporting.png import write_png

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
}

WIDTH = 9.6  # [inch] 960 px at 100 dpi: the width of a report's column
PIXELS = 120  # an inch of a png: sharp at that width, and a report of many pictures stays small


def styled():
    """Context in which figures are made and saved."""
    return rc_context(_RC)


def figure(height: float, width: float = WIDTH) -> Figure:
    """An empty figure [inch] that no pyplot state knows of."""
    return Figure(figsize=(width, height), dpi=100)


def line_style(i: int) -> dict:
    """Colour and dash of the i-th line; dashes change once the colours are used up."""
    return {"color": PALETTE[i % len(PALETTE)], "linestyle": DASHES[i // len(PALETTE) % len(DASHES)]}


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
                fig.savefig(folder / f"{stem}.{kind}", dpi=100, metadata={"Date": None})
            fig.set_layout_engine("none")  # the first file has laid it out; that takes as long as drawing
    return names
