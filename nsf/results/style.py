"""The look of every chart, in colours safe for the colour-blind: panels, scales, legends, bands and files.

Charts of reports, of inverse problems and of benchmarks are drawn with the functions here.
"""

import hashlib
import io
import itertools
import json
import math
from collections.abc import Callable, Sequence
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.colors import to_hex, to_rgb
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, LogLocator, NullFormatter
from PIL import Image

from nsf.results.columns import BASELINE
from nsf.results.formats import plain

INK, MUTED, GRID, WARNING = "#222222", "#666666", "#dddddd", "#B04A00"

# Okabe and Ito 2008, without the yellow that vanishes on white; black last.
PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#000000")
DASHES = ("-", (0, (5, 2)), (0, (1.5, 1.5)), (0, (5, 2, 1.5, 2)))

FULL, PAPER = "#7f7f7f", "#000000"

#: Colour of a model in every chart, by its name in tables (`nsf.results.columns.model_name`); Okabe and Ito
#: 2008, and Tol 2021 for models that lack one field.
MODEL_COLORS = {
    "full": FULL,
    "projected": "#0072B2",
    "projected, stress=particles": "#56B4E9",
    "projected, stress=deformation": "#882255",
    "projected, affine=none": "#332288",
    BASELINE: "#CC79A7",
    "recurrence": "#D55E00",
    "interpolate": "#009E73",
    "gru": "#E69F00",
    "dmdc": "#8A7000",
}
#: Likewise of the rivals that tables hold models to.
RIVAL_COLORS = {
    "displacement_static": "#999999",
    "displacement_nearest": "#666666",
    "displacement_interpolated": MODEL_COLORS["interpolate"],
    "displacement_coarse": FULL,
}
_OTHERS = ("#000000", "#AA4499", "#117733", "#999933", "#661100")  # models that the table lacks, in turn

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
LOST = 1000.0  # [%] error from which a run is lost, by how much tells nothing: axes end there
LOST_MARK = {"ls": "", "marker": "X", "ms": 8, "mec": "white", "mew": 0.8}
_COLORS = 256
_RAMP = 64  # colours kept of each colour scale: its bar shows no steps
# Of text, and of floors and their shadows, whose soft edges would else become contours.
_GREYS = (*range(34, 195, 17), *range(195, 256, 4))
_LETTER = 5.5  # [pt] width of a letter of a legend, or of a number below an axis, about
_ENTRY = 40.0  # [pt] width of what is about a legend's entry
_ROW = 16.5  # [pt] height of a legend's row, about
_MOST_COLUMNS = 6  # of a legend
_SPARSER = (
    (1, 2, 3, 4, 5, 6, 8),
    (1, 2, 5),
    (1, 2, 4, 8),
    (1, 3),
    (1,),
)  # ticks of a decade, where more would touch
_CELL = 4  # levels of a channel that Pillow does not tell apart when it looks up a colour


def styled():
    """Context in which figures are made and saved."""
    return rc_context(_RC)


def figure(height: float, width: float = WIDTH) -> Figure:
    """An empty figure [inch] that no pyplot state knows of."""
    return Figure(figsize=(width, height), dpi=100)


def model_color(name: str, k: int = 0, count: int = 1) -> str:
    """Colour of a model, or the k-th of so many shades of it, from dark to light."""
    others = int(hashlib.sha256(name.encode()).hexdigest(), 16) % len(_OTHERS)
    color = np.array(to_rgb(MODEL_COLORS.get(name, _OTHERS[others])))
    share = np.interp(k, [0, max(1, count - 1)], [-0.45, 0.45]) if count > 1 else 0.0
    return to_hex(color + share * (1.0 - color) if share > 0 else color * (1.0 + share))


def line_style(i: int) -> dict:
    """Colour and dash of the i-th line; dashes change once the colours are used up."""
    return {"color": PALETTE[i % len(PALETTE)], "linestyle": DASHES[i // len(PALETTE) % len(DASHES)]}


def panels(
    count: int, height: float | Sequence[float], across: int = 4, **shared
) -> tuple[Figure, list[Axes]]:
    """A figure with `count` panels, `across` in a row.

    Args:
        count, across: of panels.
        height: of a row [inch], or of each panel, of which a row takes the first.
        shared: options as of `subplots`.
    """
    rows = math.ceil(count / across)
    heights = [height] * rows if isinstance(height, float) else list(height)[::across]
    fig = figure(0.9 + sum(heights))
    grid = fig.subplots(rows, min(across, count), squeeze=False, height_ratios=heights, **shared).ravel()
    for panel in grid[count:]:
        panel.axis("off")
    return fig, list(grid[:count])


def band(panel: Axes, x, middle, low, high, **style) -> None:
    """A line in the middle of a band from `low` to `high`; `style` is of the line and has a colour."""
    panel.fill_between(x, low, high, color=style["color"], alpha=0.18, linewidth=0)
    panel.plot(x, middle, **style)


def legend(fig: Figure, title: str | None = None) -> None:
    """One legend of all panels, above them; none where everything is one line.

    Lines without a point that is drawn have no entry. A legend of more than three rows makes the figure
    higher, so that panels keep their room.
    """
    handles: dict[str, object] = {}
    for panel in fig.axes:
        for handle, text in zip(*panel.get_legend_handles_labels(), strict=True):
            if not _is_invisible(handle):
                handles.setdefault(text, handle)
    if len(handles) < 2 and not title:
        return
    columns = int(72.0 * fig.get_figwidth() / (_LETTER * max(map(len, handles), default=0) + _ENTRY))
    columns = max(1, min(len(handles), _MOST_COLUMNS, columns))
    more = math.ceil(len(handles) / columns) - 3
    fig.set_figheight(fig.get_figheight() + max(more, 0) * _ROW / 72.0)
    place = {"loc": "outside upper left", "ncols": columns, "handlelength": 2.2, "alignment": "left"}
    shown = fig.legend(list(handles.values()), list(handles), title=title, **place)
    shown.get_title().set_fontsize(9)


def _is_invisible(handle) -> bool:
    """Whether no coordinate of a line is a number, as of what the paper does not print."""
    if not hasattr(handle, "get_xydata"):
        return False
    points = np.asarray(handle.get_xydata(), float)
    return len(points) > 0 and not np.isfinite(points).all(axis=1).any()


def error_scale(panel, values, along: str = "y", hidden: float = 0.0) -> None:
    """Logarithmic once the errors span more than a factor of 30, else linear from zero; to `LOST` at most.

    Args:
        panel, values, along: whose axis is scaled for which values.
        hidden: share of the smallest that a logarithmic axis leaves out.
    """
    values = np.asarray(values, float)
    values = np.minimum(values[np.isfinite(values) & (values > 0)], LOST)
    panel.grid(axis=along)
    limits = (0, 1.08 * np.max(values, initial=1e-12))
    logarithmic = len(values) > 0 and np.max(values) > 30 * np.quantile(values, 0.05)
    if logarithmic:
        panel.set(**{f"{along}scale": "log"})
        limits = (np.quantile(values, hidden) / 1.6, np.max(values) * 1.6)
    panel.set(**{f"{along}lim": limits})
    if logarithmic:
        plain_ticks(getattr(panel, f"{along}axis"))


def plain_ticks(axis_line, text: Callable[[float], str] = "{:g}".format) -> None:
    """Give a logarithmic axis ticks as plain numbers, or as `text` says: at 1, 2 and 5 of a decade.

    At more of it where the axis spans less than a factor of 4, at 1 alone from three decades on.
    """
    low, high = axis_line.get_view_interval()
    few = (1, 2, 5) if high < 1e3 * low else (1,)
    subs = (1, 1.2, 1.5, 2, 2.5, 3, 4, 5, 6, 8) if high < 4 * low else few
    axis_line.set_major_locator(LogLocator(subs=subs))
    axis_line.set_major_formatter(FuncFormatter(lambda v, _: text(v)))
    axis_line.set_minor_formatter(NullFormatter())


def _set_apart(fig: Figure) -> None:
    """Leave fewer plain ticks below logarithmic axes where their numbers would touch, but two at least."""
    logarithmic = [panel for panel in fig.axes if isinstance(panel.xaxis.get_major_locator(), LogLocator)]
    if logarithmic:
        fig.get_layout_engine().execute(fig)  # labels beside a panel take of its width
    for panel in logarithmic:
        present = panel.xaxis.get_major_locator()
        for locator in itertools.chain([present], (LogLocator(subs=subs) for subs in _SPARSER)):
            ticks = _ticks(panel, locator)
            if len(ticks) >= 2:
                panel.xaxis.set_major_locator(locator)
                if _have_room(panel, ticks):
                    break


def _have_room(panel: Axes, ticks: Sequence[float]) -> bool:
    """Whether the numbers of ticks below a panel are two letters apart."""
    low, high = panel.get_xlim()
    letter = _LETTER * panel.figure.dpi / 72 / panel.bbox.width * math.log(high / low)
    lengths = [len(panel.xaxis.get_major_formatter()(tick)) for tick in ticks]
    return all(
        math.log(after / before) > letter * (2 + (a + b) / 2)
        for (before, a), (after, b) in itertools.pairwise(zip(ticks, lengths, strict=True))
    )


def _ticks(panel: Axes, locator: LogLocator) -> list[float]:
    """Ticks in sight that are of the locator's multiples; it has others where these are fewer than two."""
    low, high = panel.get_xlim()
    values = [v for v in locator.tick_values(low, high) if low <= v <= high]
    return [v for v in values if np.isclose(v / 10 ** math.floor(math.log10(v) + 1e-9), locator._subs).any()]


def stage_colors(stages) -> list[str]:
    """A stage has one colour in every chart; stages not listed take greys."""
    greys = itertools.cycle(("#bbbbbb", "#555555", "#dddddd", "#333333"))
    return [STAGE_COLORS[stage] if stage in STAGE_COLORS else next(greys) for stage in stages]


def fingerprint(fig: Figure) -> str:
    """sha256 of all that a figure draws: its data, colours, texts and scales, to four digits.

    It takes no rendering, and is the same whatever fonts and versions of libraries there are. To be taken
    before the figure is saved, which lays it out.
    """
    content: list = [_rounded(fig.get_size_inches()), fig.get_supxlabel()]
    for panel in fig.axes:
        content += [panel.get_xscale(), panel.get_yscale(), _rounded([*panel.get_xlim(), *panel.get_ylim()])]
        content += [panel.get_title(loc) for loc in ("left", "center")]
        content += [panel.get_xlabel(), panel.get_ylabel(), *(text.get_text() for text in panel.texts)]
        for axis in (panel.xaxis, panel.yaxis):
            if isinstance(ticks := axis.get_major_locator(), FixedLocator):
                content.append(axis.get_major_formatter().format_ticks(ticks()))
        for line in panel.lines:
            style = line.get_color(), line.get_marker(), line.get_linestyle(), line.get_linewidth()
            style += (line.get_zorder(), line.get_markerfacecolor())
            content.append([_rounded(line.get_xydata()), list(map(str, style)), line.get_label()])
        for one in panel.collections:
            content += [_rounded(one.get_offsets()), _rounded(one.get_facecolor())]
            content += [_rounded(path.vertices) for path in one.get_paths()]
        for patch in panel.patches:
            corners = patch.get_patch_transform().transform_path(patch.get_path()).vertices
            content += [_rounded(corners), _rounded(patch.get_facecolor())]
    content += [text.get_text() for one in fig.legends for text in one.get_texts()]
    return hashlib.sha256(json.dumps(content).encode(errors="backslashreplace")).hexdigest()


def _rounded(values) -> list[str]:
    return [f"{value:.4g}" for value in np.ma.filled(np.ma.asarray(values, float), np.nan).ravel()]


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
        _set_apart(fig)
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


def write_png(fig: Figure, path: Path | io.BytesIO, dpi: float, ramps: Sequence[str] = ()) -> None:
    """Write a figure without a date, in its own colours where these are few, else in those nearest to them.

    Args:
        fig: the figure; its background is white.
        path: of the file, or a buffer.
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
    fixed = [_ramp(name) for name in ramps]
    if fixed:
        fixed.append(np.repeat(np.array([_GREYS]).T, 3, axis=1))
    # With two bits less a channel it takes a sixth of the time. By the span of colours and not by their
    # pixels: the few of a thin line count as much as those of a surface.
    coarse = image.point(lambda value: value - value % _CELL + value // 64)
    count = _COLORS - sum(map(len, fixed))
    adapted = coarse.quantize(count, Image.Quantize.MAXCOVERAGE, kmeans=1, dither=Image.Dither.NONE)
    if not fixed:
        return adapted
    colors = np.concatenate([*fixed, np.array(adapted.getpalette()).reshape(-1, 3)])
    lookup = Image.new("P", (1, 1))
    # Pillow compares the lowest colour of a cell: unshifted, white would become the grey below it.
    lookup.putpalette(np.maximum(colors - _CELL // 2, 0).ravel().tolist())
    converted = image.quantize(palette=lookup, dither=Image.Dither.NONE)
    converted.putpalette(colors.ravel().tolist())
    return converted


def _ramp(name: str) -> np.ndarray:
    """Colours [_RAMP, 3] from one end of a scale to the other, in 8 bits."""
    return matplotlib.colormaps[name](np.linspace(0, 1, _RAMP), bytes=True)[:, :3].astype(int)
