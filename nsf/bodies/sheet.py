"""Rows and columns of pictures of one view, with names, colour bars and a length scale."""

from collections.abc import Mapping

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.lines import Line2D
from PIL import Image

from nsf.bodies.camera import View
from nsf.bodies.colors import ColorScale

INK, MUTED, WARNING = "#222222", "#666666", "#B04A00"
WIDTH = 9.6  # [inch] 960 px at 100 dpi: the width of a report's column


class Sheet:
    """Rows and columns of pictures of one view, with names, colour bars and a length scale."""

    def __init__(self, view: View, rows: int, columns: int, titles, inches: float = WIDTH, dpi: int = 160):
        gap, self._top, name, bottom = 0.12, 0.34, 0.30, 0.62  # [inch]
        self.view, self._wide = view, (inches - gap * (columns + 1)) / columns
        self._tall = self._wide * view.height / view.width
        self._size = (inches, self._top + rows * (self._tall + name) + bottom)
        self.fig = Figure(figsize=self._size, dpi=dpi, facecolor="white")
        self.fig.set_layout_engine("none")
        self._left = [gap + k * (self._wide + gap) for k in range(columns)]
        self._row = [self._size[1] - self._top - (k + 1) * (self._tall + name) for k in range(rows)]
        self._renderer = FigureCanvasAgg(self.fig).get_renderer()
        self._images: dict[tuple[int, int], AxesImage] = {}
        for left, title in zip(self._left, titles, strict=True):
            self._text(left, self._size[1] - 0.22, title, fontweight="bold")

    def name_row(self, row: int, text: str, warning: str = "") -> None:
        """A name above a row, and behind it what is wrong with it."""
        at = self._row[row] + self._tall + 0.09
        named = self._text(self._left[0], at, text, fontsize=9.5, color=MUTED)
        if warning:
            end = named.get_window_extent(self._renderer).x1 / self.fig.dpi
            self._text(end + 0.12, at, warning, fontsize=9.5, color=WARNING)

    def show(self, row: int, column: int, picture: np.ndarray) -> None:
        """Put pixels at a row and column, in place of those that stand there."""
        if (row, column) in self._images:
            self._images[row, column].set_data(picture)
            return
        panel = self._axes(self._left[column], self._row[row], self._wide, self._tall)
        panel.axis("off")
        self._images[row, column] = panel.imshow(picture, aspect="auto", interpolation="antialiased")

    def color_bar(self, scale: ColorScale, first: int, last: int) -> None:
        """A colour scale below some columns."""
        left, wide = self._left[first], self._left[last] - self._left[first] + self._wide
        panel = self._axes(left + 0.08 * wide, 0.42, 0.84 * wide, 0.11)
        bar = self.fig.colorbar(
            scale.mappable, cax=panel, orientation="horizontal", extend="max", extendfrac=0.03
        )
        bar.outline.set_visible(False)
        bar.ax.tick_params(labelsize=8.5, pad=2, color=MUTED, labelcolor=INK)
        bar.set_label(scale.label, fontsize=9, labelpad=2, color=INK, parse_math=False)

    def legend(self, colors: Mapping[str, str]) -> None:
        """Names of the colours, below the pictures."""
        dots = [
            Line2D([], [], color=color, label=name, linestyle="none", marker="o", markersize=6)
            for name, color in colors.items()
        ]
        self.fig.legend(handles=dots, loc="lower center", ncols=len(dots), fontsize=9, frameon=False)

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
        style = {"color": INK, "fontsize": 10, "parse_math": False, **style}
        return self.fig.text(left / self._size[0], low / self._size[1], text, va="baseline", **style)
