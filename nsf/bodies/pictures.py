"""Bodies in one view: strips over time, grids of final shapes, and the frames of a film."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from matplotlib.figure import Figure
from PIL import Image
from scipy.spatial import cKDTree

from nsf.bodies.camera import Camera, View
from nsf.bodies.colors import Categories, ColorScale
from nsf.bodies.sheet import Sheet
from nsf.bodies.solids import Solids
from nsf.vectors import drawn, spaced

WIDE = 420  # [pixel] of a picture in a strip
_THIN = 0.5  # of the larger horizontal extent: below it a body, as a slice or a frame, counts as thin
_INSIDE = 0.5  # share of all points' values below which a surface tells little of them
_CLOSED = 0.58  # of the distance to the eighth neighbour: balls of this radius look closed
_NEIGHBOURS = 4000  # points whose neighbours set the radius
_LOOKS = 7  # frames by which a window is chosen
_WHITE = 250  # of 255: a brighter pixel shows no point


@dataclass(frozen=True)
class Body:
    """A body over time, and what stands about it.

    Attributes:
        x: [F, n, 3] [m], the first frame at rest.
        values: [F, n] by which its points are coloured, in SI.
        scale: their colours.
        around: gravity and colliders in the frames, as `nsf.evaluation.surroundings` returns them; none by
            default.
        name: said above its row; warning: said behind the name, in another colour.
        through: opacity by value (of `Categories`) of points that are seen through the others.
        radius: of its points [m]; by default so that they look closed at rest.
    """

    x: np.ndarray
    values: np.ndarray
    scale: ColorScale | Categories
    around: Mapping[str, np.ndarray] = field(default_factory=dict)
    name: str = ""
    warning: str = ""
    through: Mapping[int, float] = field(default_factory=dict)
    radius: float | None = None


class Stage:
    """Where bodies are seen from: one camera, window and size of points for all their pictures.

    Gravity points down in it, since a scene may be in the frame of an inclined plane.

    Args:
        bodies: all that are shown.
        cut: whether the front half is cut away; not of a thin body, which hides nothing inside.
        shown: frames that are; some of all by default.
    """

    def __init__(self, bodies: Sequence[Body], cut: bool = False, shown: Sequence[int] | None = None):
        self._solids = {id(body): Solids(body.around, body.x[0].mean(axis=0, dtype=float)) for body in bodies}
        self._radius = {id(body): body.radius or closed_radius(body.x[0]) for body in bodies}
        frames = [
            (body, k) for body in bodies for k in (spaced(len(body.x), _LOOKS) if shown is None else shown)
        ]
        seen, rest = [self._placed(body, k) for body, k in frames], self._placed(bodies[0], 0)
        self.camera = Camera.facing(rest)
        self._cut = cut and is_cut_open(rest)
        self._middle = rest.mean(axis=0, dtype=float)
        # How far the ground of every body goes on: as far as any of them comes.
        reach = self._solids[id(bodies[0])].reach(seen)
        for solids in self._solids.values():
            solids.reached = reach
        faces = [face.corners for body, k in frames for face in self._faces(body, k)]
        corners, radius = np.concatenate(faces) if faces else None, max(self._radius.values())
        self._window = View.around(np.concatenate(seen), 100, self.camera, corners, radius)

    def view(self, width: int) -> View:
        """The window, so many pixels wide."""
        return replace(self._window, width=width)

    def picture(self, view: View, body: Body, frame: int) -> np.ndarray:
        """Pixels of a body and the colliders about it in a frame."""
        x, values = self._placed(body, frame), body.values[frame]
        if self._cut:
            rows = self._behind(body)
            x, values = x[rows], values[rows]
        radius, faces = self._radius[id(body)], self._faces(body, frame)
        hidden = np.where(np.isin(values, list(body.through)), 0, values) if body.through else values
        picture = view.picture(x, body.scale.colors(hidden), radius, faces)
        for value, opacity in body.through.items():
            chosen = values == value
            over = view.picture(x[chosen], body.scale.colors(values[chosen]), radius)
            picture = _laid_over(picture, over, opacity)
        return picture

    def _placed(self, body: Body, frame: int) -> np.ndarray:
        return self._solids[id(body)].turned(np.asarray(body.x[frame]))

    def _faces(self, body: Body, frame: int) -> list:
        return self._solids[id(body)].faces(frame % len(body.x), self.camera.axes[2])

    def _behind(self, body: Body) -> np.ndarray:
        """[n] whether points start behind the middle, as the camera sees them."""
        toward = self.camera.axes[2] * (1.0, 1.0, 0.0)
        return (self._placed(body, 0) - self._middle) @ toward <= 0.0


def strip(bodies: Sequence[Body], t: np.ndarray, count: int = 5, cut: bool = False) -> Figure:
    """The motion of bodies in `count` pictures each, a row a body.

    Args:
        bodies: of the same frames and one colour scale.
        t: [F] [s].
        count: of frames; all where there are fewer.
        cut: whether the front half is cut away.
    """
    chosen = spaced(len(t), count)
    stage, titles = Stage(bodies, cut, chosen), [f"t = {t[k]:.3g} s" for k in chosen]
    sheet = _sheet(stage, [[body] * len(chosen) for body in bodies], titles, WIDE)
    for row, body in enumerate(bodies):
        for column, k in enumerate(chosen):
            sheet.show(row, column, stage.picture(stage.view(WIDE), body, int(k)))
    return sheet.fig


def grid(rows: Sequence[Sequence[Body]], titles: Sequence[str], cut: bool = False) -> Figure:
    """The last frame of bodies in rows and columns.

    Args:
        rows: of each row a body a column; the first names the row. Bodies of a column have one colour scale.
        titles: of the columns.
        cut: whether the front half is cut away.
    """
    stage = Stage([body for row in rows for body in row], cut, [-1])
    width = round(WIDE * 5 / (len(titles) + 1))
    sheet = _sheet(stage, rows, titles, width)
    for i, row in enumerate(rows):
        for j, body in enumerate(row):
            sheet.show(i, j, stage.picture(stage.view(width), body, -1))
    return sheet.fig


def frames(
    rows: Sequence[Sequence[Body]], t: np.ndarray, titles: Sequence[str], most: int | None = 31,
    size: int = 760, cut: bool = False,
) -> Iterator[Image.Image]:  # fmt: skip
    """Pictures of a film: bodies in rows and columns, with the time.

    Args:
        rows, titles, cut: as for `grid`.
        t: [F] [s].
        most: frames, evenly spread; all for None.
        size: of a picture across [pixel].
    """
    stage = Stage([body for row in rows for body in row], cut)
    view = stage.view(max(1, size // len(titles)))
    sheet = _sheet(stage, rows, titles, view.width, inches=size / 100 + 0.5, dpi=100)
    clock = sheet.clock()
    for k in spaced(len(t), most or len(t)):
        for i, row in enumerate(rows):
            for j, body in enumerate(row):
                sheet.show(i, j, stage.picture(view, body, int(k)))
        clock.set_text(f"t = {t[k]:.3f} s")
        yield sheet.pixels()


def is_cut_open(X: np.ndarray) -> bool:
    """Whether pictures cut the front half of a body X [n, 3] away: not of a thin one, which hides nothing."""
    extent = np.ptp(X[:, :2], axis=0)
    return bool(extent.min() > _THIN * extent.max())


def hides_inside(X: np.ndarray, x: np.ndarray, values: np.ndarray) -> bool:
    """Whether values [n] lie within a body x [n, 3], X at rest: its surface carries little of them."""
    front = View.around(x, 100).front(x, closed_radius(X))
    return is_cut_open(X) and bool(values[front].mean() < _INSIDE * values.mean())


def _sheet(stage: Stage, rows, titles: Sequence[str], width: int, **size) -> Sheet:
    """A sheet with the names of its rows and the scales of its columns, and no pictures yet."""
    sheet = Sheet(stage.view(width), len(rows), len(titles), titles, **size)
    for i, row in enumerate(rows):
        sheet.name_row(i, row[0].name, row[0].warning)
    scales = [body.scale for body in rows[0]]
    for scale in dict.fromkeys(scales):
        columns = [j for j, one in enumerate(scales) if one is scale]
        if isinstance(scale, Categories):
            sheet.legend(scale.named)
        else:
            sheet.color_bar(scale, columns[0], columns[-1])
    sheet.scale_bar()
    return sheet


def _laid_over(picture: np.ndarray, over: np.ndarray, opacity: float) -> np.ndarray:
    """Pixels with those of another picture over them, where that shows a point."""
    mixed = (1 - opacity) * picture + opacity * over
    return np.where((over < _WHITE).any(axis=-1, keepdims=True), mixed, picture).astype(np.uint8)


def closed_radius(X: np.ndarray) -> float:
    """A ball's radius [m] at which points X [n, 3] look closed: from how near their neighbours are."""
    some = drawn(len(X), _NEIGHBOURS)
    reach = cKDTree(X).query(X[some], min(9, len(X)))[0][:, -1]
    return max(_CLOSED * float(np.median(reach)), 1e-9)
