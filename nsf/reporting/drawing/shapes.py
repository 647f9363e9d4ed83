"""Particle pictures: final shapes and animations of the full-order and the reduced model side by side."""

import io
from dataclasses import replace
from typing import TYPE_CHECKING

import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from PIL import Image

from nsf.reporting.drawing.camera import Camera, View
from nsf.reporting.drawing.style import (
    CLIP,
    DIFFERENCE_COLORS,
    INK,
    METRES,
    MUTED,
    PASCALS,
    STRESS_COLORS,
    WARNING,
    WIDTH,
    ColorScale,
    styled,
)
from nsf.reporting.sources import Motion
from nsf.reporting.text.columns import parameter_text

if TYPE_CHECKING:
    from nsf.evaluation import SuperResolution

GIF_BYTES = 2**20
_THIN = 0.5  # of the larger horizontal extent: below it a body, as a slice or a frame, counts as thin


def final_shapes(
    motions: list[Motion], name: str = "parameter", unit: str = "", floor: float | None = None
) -> Figure:
    """Last frame of each parameter value: full-order, reduced, and the distance between the two.

    The front half is cut away (`is_cut_open`): a free surface carries little stress, the inside does.

    Args:
        motions: one a row; positions in metres.
        name, unit: of the problem parameter.
        floor: height of the floor line [m]; None draws none.
    """
    motions = _cut_open(motions)
    last = [(m, m.x_full[-1], m.x_reduced[-1], m.stress_full[-1], m.stress_reduced[-1]) for m in motions]
    stress = ColorScale.up_to(np.percentile([s[3] for s in last], CLIP), STRESS_COLORS, PASCALS)
    apart = [np.linalg.norm(x_rom - x_fom, axis=-1) for _, x_fom, x_rom, *_ in last]
    distance = ColorScale.up_to(_percentile(np.concatenate(apart), 99.5), DIFFERENCE_COLORS, METRES)
    view = View.around(np.concatenate([x_fom for _, x_fom, *_ in last]), width=520, floor=floor)
    radius = _radius(motions[0].x_full[0])
    with styled():
        sheet = _Sheet(view, rows=len(motions), columns=3, titles=("full-order", "reduced", "distance apart"))
        for row, ((m, x_fom, x_rom, stress_fom, stress_rom), d) in enumerate(zip(last, apart, strict=True)):
            sheet.name_row(row, f"{parameter_text(m.parameter, name, unit)}, t = {m.t[-1]:.3g} s")
            sheet.note_stop(row, m)
            sheet.show(row, 0, view.picture(x_fom, stress.colors(stress_fom), radius))
            sheet.show(row, 1, view.picture(x_rom, stress.colors(stress_rom), radius))
            sheet.show(row, 2, view.picture(x_rom, distance.colors(d), radius))
        sheet.color_bar(stress, 0, 1, "von Mises equivalent of the Kirchhoff stress")
        sheet.color_bar(distance, 2, 2, "distance ‖x_rom − x_fom‖")
        sheet.scale_bar()
    return sheet.fig


def fine_shapes(
    fine: list["SuperResolution"], name: str = "parameter", unit: str = "", floor: float | None = None
) -> Figure:
    """Last frame of the reduced run at its particles and at many more points, and the fine full-order run.

    Whole bodies, coloured by ‖x − X‖: a picture of many points shows the surface, which carries no stress.

    Args:
        fine: one a row.
        name, unit: of the problem parameter.
        floor: height of the floor line [m]; None draws none.
    """
    distances = np.linalg.norm(fine[0].x_full - fine[0].X, axis=1)
    moved = ColorScale.up_to(_percentile(distances, 99.5), STRESS_COLORS, METRES)
    view = View.around(np.concatenate([f.x_full for f in fine]), width=520, floor=floor)
    count, more = len(fine[0].particles), len(fine[0].X)
    titles = (f"reduced, {count:,} particles", f"reduced, {more:,} points", f"full-order, {more:,} particles")
    few, many = (_radius(fine[0].X[rows]) for rows in (fine[0].particles, ...))
    with styled():
        sheet = _Sheet(view, rows=len(fine), columns=3, titles=titles)
        for row, f in enumerate(fine):
            sheet.name_row(row, parameter_text(f.row["parameter"], name, unit))
            shown = ((f.x_reduced, f.particles, few), (f.x_reduced, ..., many), (f.x_full, ..., many))
            for column, (x, rows, radius) in enumerate(shown):
                X, x = f.X[rows], x[rows]
                front = view.front(x, radius)
                colors = moved.colors(np.linalg.norm(x[front] - X[front], axis=1))
                sheet.show(row, column, view.picture(x[front], colors, radius))
        sheet.color_bar(moved, 0, 2, "displacement ‖x − X‖")
        sheet.scale_bar()
    return sheet.fig


def strip(
    motion: Motion, name: str = "parameter", unit: str = "", floor: float | None = None, count: int = 5
) -> Figure:
    """The motion of one parameter value in `count` pictures: full-order above, reduced below, whole bodies.

    Args:
        motion: positions in metres.
        name, unit: of the problem parameter.
        floor: height of the floor line [m]; None draws none.
    """
    frames = np.unique(np.linspace(0, len(motion.t) - 1, count).round().astype(int))
    stress = ColorScale.up_to(np.percentile(motion.stress_full, CLIP), STRESS_COLORS, PASCALS)
    view = View.around(motion.x_full[frames].reshape(-1, 3), width=420, floor=floor)
    radius = _radius(motion.x_full[0])
    value = parameter_text(motion.parameter, name, unit)
    with styled():
        sheet = _Sheet(view, 2, len(frames), [f"t = {motion.t[k]:.3g} s" for k in frames])
        rows = (
            ("full-order", motion.x_full, motion.stress_full),
            ("reduced", motion.x_reduced, motion.stress_reduced),
        )
        for row, (model, x, values) in enumerate(rows):
            sheet.name_row(row, f"{model}, {value}")
            for column, k in enumerate(frames):
                sheet.show(row, column, view.picture(x[k], stress.colors(values[k]), radius))
        sheet.note_stop(1, motion)
        sheet.color_bar(stress, 0, len(frames) - 1, "von Mises equivalent of the Kirchhoff stress")
        sheet.scale_bar()
    return sheet.fig


def animation(
    motions: list[Motion], path, name: str = "parameter", unit: str = "", floor: float | None = None,
    frames: int = 31, width: int = 380, max_bytes: int = GIF_BYTES,
) -> None:  # fmt: skip
    """Write a gif: the full-order model beside the reduced one, cut open, coloured by stress, with the time.

    Args:
        motions: one or two parameter values, a row each.
        path: of the gif.
        frames: at most this many, evenly spread over the simulated time.
        width: of one picture [pixel].
        max_bytes: colours, size and frames are given up in that order until the file is no larger.
    """
    motions = _cut_open(motions)
    x_full = np.concatenate([m.x_full.reshape(-1, 3) for m in motions])
    stress = ColorScale.up_to(np.percentile([m.stress_full for m in motions], CLIP), STRESS_COLORS, PASCALS)
    view = View.around(x_full, width=width, floor=floor)
    radius = _radius(motions[0].x_full[0])
    count = len(motions[0].t)
    chosen = np.unique(np.linspace(0, count - 1, min(frames, count)).round().astype(int))
    images = []
    with styled():
        sheet = _Sheet(
            view, len(motions), 2, ("full-order", "reduced"), inches=2 * width / 100 + 0.5, dpi=100
        )
        sheet.color_bar(stress, 0, 1, "von Mises equivalent of the Kirchhoff stress")
        sheet.scale_bar()
        clock = sheet.clock()
        for row, m in enumerate(motions):
            sheet.name_row(row, parameter_text(m.parameter, name, unit))
            sheet.note_stop(row, m)
        for frame in chosen:
            for row, m in enumerate(motions):
                models = ((m.x_full, m.stress_full), (m.x_reduced, m.stress_reduced))
                for column, (x, values) in enumerate(models):
                    sheet.show(row, column, view.picture(x[frame], stress.colors(values[frame]), radius))
            clock.set_text(f"t = {motions[0].t[frame]:.2f} s")
            images.append(sheet.pixels())
    path.write_bytes(_gif(images, max_bytes))


class _Sheet:
    """Rows and columns of pictures of one view, with names, colour bars and a length scale."""

    def __init__(self, view: View, rows: int, columns: int, titles, inches: float = WIDTH, dpi: int = 160):
        gap, self._top, name, bottom = 0.12, 0.34, 0.30, 0.62  # [inch]
        self.view, self._wide = view, (inches - gap * (columns + 1)) / columns
        self._tall = self._wide * view.height / view.width
        self._size = (inches, self._top + rows * (self._tall + name) + bottom)
        self.fig = Figure(figsize=self._size, dpi=dpi)
        self.fig.set_layout_engine("none")
        self._left = [gap + k * (self._wide + gap) for k in range(columns)]
        self._row = [self._size[1] - self._top - (k + 1) * (self._tall + name) for k in range(rows)]
        self._images: dict[tuple[int, int], AxesImage] = {}
        for left, title in zip(self._left, titles, strict=True):
            self._text(left, self._size[1] - 0.22, title, fontweight="bold")

    def name_row(self, row: int, text: str) -> None:
        self._text(self._left[0], self._row[row] + self._tall + 0.09, text, fontsize=9.5, color=MUTED)

    def note_stop(self, row: int, motion: Motion) -> None:
        """Over the reduced picture of a run that diverged: what stands there is its last good state."""
        if motion.stopped is not None:
            told = f"diverged; shown as at t = {motion.stopped:.3g} s"
            self._text(self._left[1], self._row[row] + self._tall + 0.09, told, fontsize=9.5, color=WARNING)

    def show(self, row: int, column: int, picture: np.ndarray) -> None:
        if (row, column) in self._images:
            self._images[row, column].set_data(picture)
            return
        panel = self._axes(self._left[column], self._row[row], self._wide, self._tall)
        panel.axis("off")
        self._images[row, column] = panel.imshow(picture, aspect="auto", interpolation="antialiased")

    def color_bar(self, scale: ColorScale, first: int, last: int, title: str) -> None:
        left, wide = self._left[first], self._left[last] - self._left[first] + self._wide
        panel = self._axes(left + 0.08 * wide, 0.42, 0.84 * wide, 0.11)
        bar = self.fig.colorbar(
            scale.mappable, cax=panel, orientation="horizontal", extend="max", extendfrac=0.03
        )
        bar.outline.set_visible(False)
        bar.ax.tick_params(labelsize=8.5, pad=2)
        bar.set_label(f"{title} [{scale.unit}]", fontsize=9, labelpad=2)

    def scale_bar(self) -> None:
        """A length of 1, 2 or 5 times a power of ten, about a fifth of the first picture."""
        goal = 0.2 * self.view.metres_across
        power = 10.0 ** np.floor(np.log10(goal))
        length = max(step * power for step in (1, 2, 5) if step * power <= goal)
        wide = self._wide * length / self.view.metres_across
        left, low = self._left[0] + 0.1, self._row[0] + 0.09
        panel = self._axes(left, low, wide, 0.03)
        panel.set_facecolor(INK)
        panel.set_zorder(2)
        panel.tick_params(bottom=False, left=False, labelbottom=False, labelleft=False)
        for spine in panel.spines.values():
            spine.set_visible(False)
        self._text(left, low + 0.08, f"{length:g} m", fontsize=8.5)

    def clock(self):
        """A text at the upper right, empty for now."""
        return self._text(self._size[0] - 0.12, self._size[1] - 0.22, "", ha="right", fontweight="bold")

    def pixels(self) -> Image.Image:
        """The sheet as it stands, drawn."""
        canvas = FigureCanvasAgg(self.fig)
        canvas.draw()
        return Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3].copy())

    def _axes(self, left: float, low: float, wide: float, tall: float):
        width, height = self._size
        return self.fig.add_axes((left / width, low / height, wide / width, tall / height))

    def _text(self, left: float, low: float, text: str, **style):
        return self.fig.text(left / self._size[0], low / self._size[1], text, va="baseline", **style)


def is_cut_open(motions: list[Motion]) -> bool:
    """Whether pictures cut the front half away: not of a thin body, which hides nothing inside."""
    extent = np.ptp(motions[0].x_full[0][:, :2], axis=0)
    return bool(extent.min() > _THIN * extent.max())


def _cut_open(motions: list[Motion]) -> list[Motion]:
    """The particles that start behind the middle, as the camera sees them; the same of every motion."""
    if not is_cut_open(motions):
        return motions
    X = motions[0].x_full[0].astype(float)
    toward = Camera.facing(motions[0].x_full).axes[2] * (1.0, 1.0, 0.0)
    behind = (X - X.mean(axis=0)) @ toward <= 0.0

    def cut(motion: Motion) -> Motion:
        names = ("x_full", "x_reduced", "stress_full", "stress_reduced")
        return replace(motion, **{name: getattr(motion, name)[:, behind] for name in names})

    return [cut(motion) for motion in motions]


def _radius(X: np.ndarray) -> float:
    """A sphere's radius [m] at which particles X [n, 3] look closed: from the volume they fill."""
    volume = np.prod(np.maximum(np.ptp(X.astype(float), axis=0), 1e-6))
    return 0.62 * (volume / len(X)) ** (1 / 3)


def _percentile(values: np.ndarray, percent: float) -> float:
    finite = values[np.isfinite(values)]
    return float(np.percentile(finite, percent)) if len(finite) else 0.0


def _gif(images: list[Image.Image], max_bytes: int) -> bytes:
    """An endless gif; gives up colours, size and frames, in that order, while it is larger than max_bytes."""
    steps = ((128, 1, 1), (64, 1, 1), (32, 1, 1), (48, 0.75, 1), (48, 0.75, 2), (32, 0.5, 2))
    for colors, scale, step in steps:
        width, height = images[0].size
        size = (round(width * scale), round(height * scale))
        kept = [*images[:-1:step], images[-1]]
        data = _encode([image if scale == 1 else image.resize(size) for image in kept], colors)
        if len(data) <= max_bytes:
            break
    return data


def _encode(images: list[Image.Image], colors: int) -> bytes:
    """One palette for all frames, no dithering: unchanged pixels stay unchanged and compress away.

    The palette holds white, greys and the colour scale as they are, and `colors` more that suit the frames.
    """
    sample = images[:: max(1, len(images) // 6)]
    width, height = images[0].size
    montage = Image.new("RGB", (width, height * len(sample)))
    for k, image in enumerate(sample):
        montage.paste(image, (0, k * height))
    quantized = montage.quantize(colors, method=Image.Quantize.MEDIANCUT)
    adapted = np.array(quantized.getpalette(), dtype=int).reshape(-1, 3)
    adapted = adapted[np.ptp(adapted, axis=1) > 12]  # a grey of its own would tint the white
    greys = np.repeat([*range(0, 160, 20), *range(160, 255, 6), 241, 255], 3)
    ramp = 255 * matplotlib.colormaps[STRESS_COLORS](np.linspace(0, 1, 64))[:, :3]
    palette = Image.new("P", (1, 1))
    palette.putpalette(
        [*greys.tolist(), *ramp.round().astype(int).ravel().tolist(), *adapted.ravel().tolist()]
    )
    frames = [_indexed(image, palette, white=greys.size // 3 - 1) for image in images]
    durations = [80] * (len(frames) - 1) + [1600]
    stream = io.BytesIO()
    more = {"append_images": frames[1:], "duration": durations, "loop": 0, "optimize": True, "disposal": 1}
    frames[0].save(stream, "GIF", save_all=True, **more)
    return stream.getvalue()


def _indexed(image: Image.Image, palette: Image.Image, white: int) -> Image.Image:
    """An image in the palette's colours; Pillow's nearest colour is coarse, so white is put right."""
    indices = np.array(image.quantize(palette=palette, dither=Image.Dither.NONE))
    indices[(np.asarray(image) == 255).all(axis=2)] = white
    indexed = Image.fromarray(indices)
    indexed.putpalette(palette.getpalette() or [])
    return indexed
