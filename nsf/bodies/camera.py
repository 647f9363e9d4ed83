"""An orthographic camera that draws points as a lit surface of grains into an array of pixels; z is up.

Written in numpy, since VTK needs the graphics libraries of a system and a report is to be drawn without them.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from PIL import Image, ImageDraw
from scipy.ndimage import uniform_filter

from nsf.bodies.solids import Face

_LIGHT = np.array([-0.45, 0.65, 0.62]) / np.linalg.norm([-0.45, 0.65, 0.62])  # in camera axes
_AMBIENT = 0.66  # share of a surface's colour that light does not model: keeps the colour map readable
_OCCLUSION = 0.40  # how much nearer surroundings darken what lies behind them
_OCCLUDED = (2.5, 8.0)  # radii of a point, about which surroundings are compared
_SHADOW, _EDGE = 0.20, 0.45  # how dark a shadow is, and an edge of a solid
_GLAZE = 0.06  # white mixed in, so that the dark end of a colour map still shows its shape
_SMOOTH = 0.9  # radii of a point, over which depth and colour are smooth
_GRAINS = (3.0, 12.0)  # radii [sample] between which points turn from a surface into balls
_LARGE = 6  # radius [sample] above which balls are drawn one by one, which is faster then
_CASTERS = 20_000  # points that throw a shadow
_BEYOND = 0.35  # of the body's extent: how far a window opens for the solids beside it
_OVERSAMPLE = 2


@dataclass(frozen=True)
class Camera:
    """Orthographic view: `azimuth` [°] about z (−90 looks along +y), `elevation` [°] above the floor."""

    azimuth: float = -62.0
    elevation: float = 16.0

    @classmethod
    def facing(cls, x: np.ndarray) -> "Camera":
        """A view across the wider horizontal side of the points x [..., 3]."""
        extent = np.ptp(x.reshape(-1, 3), axis=0)
        return cls(azimuth=-62.0 if extent[0] >= 0.8 * extent[1] else -28.0)

    @property
    def axes(self) -> np.ndarray:
        """Rows: right, up and toward the viewer, as unit vectors [3,3]."""
        a, e = np.deg2rad([self.azimuth, self.elevation])
        toward = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
        right = np.array([-np.sin(a), np.cos(a), 0.0])
        return np.stack([right, np.cross(toward, right), toward])

    def project(self, x: np.ndarray) -> np.ndarray:
        """x [..., 3] in camera axes: right, up, toward [m]."""
        return x @ self.axes.T


@dataclass(frozen=True)
class View:
    """A camera's window: `low`, `high` [m] in right and up, `width` [pixel]."""

    camera: Camera
    low: np.ndarray
    high: np.ndarray
    width: int

    @classmethod
    def around(
        cls,
        x: np.ndarray,
        width: int,
        camera: Camera | None = None,
        solids: np.ndarray | None = None,
        radius: float = 0.0,
    ) -> "View":
        """The window of all balls of a radius [m] about x [..., 3] and, within reason, of `solids` [k, 3]."""
        points = x.reshape(-1, 3)
        points = points[np.isfinite(points).all(axis=1)]
        camera = camera or Camera.facing(points)
        flat = camera.project(points)[:, :2]
        low, high = flat.min(axis=0) - radius, flat.max(axis=0) + radius
        reach = _BEYOND * max(high - low)
        if solids is not None and len(solids):
            seen = camera.project(solids)[:, :2]
            low, high = (
                np.maximum(np.minimum(low, seen.min(axis=0)), low - reach),
                np.minimum(np.maximum(high, seen.max(axis=0)), high + reach),
            )
        margin = 0.04 * max(high - low)
        # More below, where the length scale stands.
        return cls(camera, low - margin * np.array([1.0, 2.5]), high + margin, width)

    @property
    def height(self) -> int:
        """Pixels upward."""
        extent = self.high - self.low
        return max(8, round(self.width * extent[1] / extent[0]))

    @property
    def metres_across(self) -> float:
        """Width of the window [m]."""
        return float(self.high[0] - self.low[0])

    def picture(
        self, x: np.ndarray, colors: np.ndarray, radius: float, faces: Sequence[Face] = ()
    ) -> np.ndarray:
        """Points x [n,3] m of colors [n,3] in 0..1, lit: pixels [height,width,3], 8 bits.

        Each is a ball of this radius [m]. Balls of a few pixels are seen as such; smaller ones melt into one
        surface, whose shape and colour are smooth over about a radius. Points that are not finite are left
        out. Of solids, `faces` are what is seen.
        """
        scale = self.width * _OVERSAMPLE / self.metres_across
        shape = (self.height * _OVERSAMPLE, self.width * _OVERSAMPLE)
        alive = np.isfinite(x).all(axis=1)
        x, colors = x[alive], colors[alive]
        canvas = np.ones((*shape, 3), np.float32)
        nearest = np.full(shape, -np.inf, np.float32)
        for face in faces:
            if face.opacity == 1.0:
                self._paint(face, canvas, nearest, scale)
                if face.ground:
                    self._shade(face, x, canvas, radius, scale)
        if len(x):
            rows = self.front(x, radius)
            self._draw(x[rows], colors[rows], radius, scale, canvas, nearest)
        for face in sorted(faces, key=lambda face: self.camera.project(face.corners)[:, 2].mean()):
            if face.opacity < 1.0:
                self._paint(face, canvas, nearest, scale)
        # Slices are added, since `mean` over two axes takes eight times as long.
        offsets = [(row, column) for row in range(_OVERSAMPLE) for column in range(_OVERSAMPLE)]
        mean = sum(canvas[row::_OVERSAMPLE, column::_OVERSAMPLE] for row, column in offsets) / len(offsets)
        return (255 * np.clip(mean, 0, 1)).astype(np.uint8)

    def front(self, x: np.ndarray, radius: float) -> np.ndarray:
        """Rows of the points x [n, 3] m within six radii [m] of the foremost about them.

        The others are hidden behind these; of millions it leaves those that a picture shows.
        """
        alive = np.flatnonzero(np.isfinite(x).all(axis=1))
        right, up, toward = self.camera.project(x[alive]).T
        columns = int((right.max() - right.min()) / radius) + 1
        cell = ((up - up.min()) / radius).astype(int) * columns + ((right - right.min()) / radius).astype(int)
        foremost = np.full(cell.max() + 1, -np.inf)
        np.maximum.at(foremost, cell, toward)
        return alive[toward >= foremost[cell] - 6.0 * radius]

    def _draw(self, x, colors, radius: float, scale: float, canvas: np.ndarray, nearest: np.ndarray) -> None:
        """Draw points where nothing is nearer."""
        centre = self._pixels(self.camera.project(x), scale)
        depths, owner, normal = _balls(centre, radius, scale, nearest.shape)
        covered = owner >= 0
        if not covered.any():
            return
        part = _box_of(np.argwhere(covered), nearest.shape)
        covered, depths, normal = covered[part], depths[part], normal[part]
        painted = np.zeros((*covered.shape, 3), np.float32)
        painted[covered] = colors[owner[part][covered]]
        surface = _surface(covered, np.where(covered, depths, 0.0), painted, normal, radius, scale)
        shown = covered & (depths > nearest[part])
        canvas[part][shown] = surface[shown]
        nearest[part][shown] = depths[shown]

    def _pixels(self, projected: np.ndarray, scale: float) -> np.ndarray:
        """Camera axes [m] to column, row [pixel] and nearness [m]."""
        column = (projected[:, 0] - self.low[0]) * scale
        row = (self.high[1] - projected[:, 1]) * scale
        return np.stack([column, row, projected[:, 2]], axis=1)

    def _paint(self, face: Face, canvas: np.ndarray, nearest: np.ndarray, scale: float) -> None:
        """Draw a face where nothing is nearer; an opaque one hides what comes later and lies behind."""
        at = self._pixels(self.camera.project(face.corners), scale)
        inside, edge = (_outlined(at[:, :2], nearest.shape, fill) for fill in (True, False))
        part = _box_of(at[:, 1::-1], nearest.shape)
        (dx, dy, d0), *_ = np.linalg.lstsq(
            np.column_stack([at[:, :2], np.ones(len(at))]), at[:, 2], rcond=None
        )
        rows, columns = (np.arange(span.start, span.stop, dtype=np.float32) for span in part)
        depth = d0 + dx * columns + dy * rows[:, None]
        seen = depth >= nearest[part] - 1e-4 * self.metres_across
        for mask, color, opacity in (
            (inside[part] & seen, face.color, face.opacity),
            (edge[part] & seen, 0.75 * face.color, _EDGE),
        ):
            into = canvas[part]
            into[mask] = (1 - opacity) * into[mask] + np.float32(opacity) * color.astype(np.float32)
        if face.opacity == 1.0:
            mask = inside[part] & seen
            nearest[part][mask] = depth[mask]

    def _shade(self, face: Face, x: np.ndarray, canvas: np.ndarray, radius: float, scale: float) -> None:
        """The shadow of the points on a face."""
        light, normal = _LIGHT @ self.camera.axes, face.normal
        above = (x - face.corners[0]) @ normal
        rows = np.flatnonzero(above > -radius)
        if light @ normal < 0.1 or not len(rows):
            return
        rows = rows[:: -(-len(rows) // _CASTERS)]
        fallen = x[rows] - (above[rows] / (light @ normal))[:, None] * light
        shape = canvas.shape[:2]
        _, owner, _ = _balls(self._pixels(self.camera.project(fallen), scale), radius, scale, shape, 0.35)
        shadow = (owner >= 0).astype(np.float32)
        at = self._pixels(self.camera.project(face.corners), scale)
        shadow = _blurred(shadow, max(2.0 * radius * scale, 4.0)) * _outlined(at[:, :2], shape, True)
        canvas *= 1 - _SHADOW * shadow[..., None]


def _box_of(at: np.ndarray, shape) -> tuple[slice, slice]:
    """Rows and columns that hold the pixels at [k, 2] (row, column), within a picture."""
    low = np.clip(np.floor(at.min(axis=0)) - 1, 0, shape).astype(int)
    high = np.clip(np.ceil(at.max(axis=0)) + 2, 0, shape).astype(int)
    return slice(low[0], high[0]), slice(low[1], high[1])


def _outlined(corners: np.ndarray, shape, fill: bool) -> np.ndarray:
    """Pixels within a polygon of corners [k, 2] (column, row), or on its outline."""
    picture = Image.new("1", (shape[1], shape[0]))
    points = [(float(column), float(row)) for column, row in corners]
    if fill:
        ImageDraw.Draw(picture).polygon(points, fill=1)
    else:
        ImageDraw.Draw(picture).line([*points, points[0]], fill=1, width=_OVERSAMPLE)
    return np.array(picture)


def _surface(covered, depth, colors, normals, radius: float, scale: float) -> np.ndarray:
    """Colours [h, w, 3] of points, lit: balls where they are large, one smooth surface where they are small.

    What lies more than two radii before or behind its surroundings takes no part in them.

    Args:
        covered: [h, w] where there are points.
        depth: [h, w] nearness [m] there.
        colors: [h, w, 3] of the point that is seen.
        normals: [h, w, 3] of its ball, in camera axes.
        radius: of a point [m].
        scale: pixels a metre.
    """
    reach = _SMOOTH * radius * scale
    weight = covered.astype(np.float32)
    rough = _blurred(depth * weight, reach) / np.maximum(_blurred(weight, reach), 1e-6)
    weight *= np.exp(-(((depth - rough) / (2.0 * radius)) ** 2))
    total = np.maximum(_blurred(weight, reach), 1e-6)
    even = np.where(weight > 0.1, _blurred(depth * weight, reach) / total, depth)
    down, right = np.gradient(even * scale)
    down[~covered] = right[~covered] = 0.0
    melted = np.stack([-right, down, np.ones_like(even)], axis=-1)
    melted /= np.linalg.norm(melted, axis=-1, keepdims=True)
    grains = float(np.interp(radius * scale, _GRAINS, (0.0, 1.0)))
    normal = (1 - grains) * melted + grains * normals
    facing = normal @ _LIGHT.astype(np.float32) / np.maximum(np.linalg.norm(normal, axis=-1), 1e-6)
    tone = (_AMBIENT + (1 - _AMBIENT) * np.clip(facing, 0.0, 1.0)) * _occlusion(covered, even, radius, scale)
    if grains < 1.0:
        smooth = np.stack([_blurred(colors[..., k] * weight, reach) / total for k in range(3)], axis=-1)
        colors = (1 - grains) * smooth + grains * colors
    return (_GLAZE + (1 - _GLAZE) * colors) * tone[..., None]


def _balls(centre: np.ndarray, radius: float, scale: float, shape, squash: float = 1.0):
    """The nearest of balls in each pixel.

    Args:
        centre: [n, 3] column, row [pixel] and nearness [m].
        radius: [m]; scale: pixels a metre.
        shape: of the picture.
        squash: height of a ball's outline over its width.

    Returns:
        nearness [h, w] [m], -inf where there is none; whose it is [h, w], -1 where there is none; the normal
        of that ball there [h, w, 3].
    """
    pixels = max(radius * scale, 0.8)
    reach = int(np.ceil(pixels))
    dx, dy = np.meshgrid(np.arange(-reach, reach + 1), np.arange(-reach, reach + 1))
    apart = dx**2 + (dy / squash) ** 2
    bulge = np.sqrt(np.maximum(0.0, 1 - (dx**2 + dy**2) / pixels**2)).astype(np.float32)
    normals = np.stack([dx / pixels, -dy / pixels, bulge], axis=-1).astype(np.float32)
    cell = np.where(apart <= pixels**2, radius * bulge, -np.inf).astype(np.float32)
    drawn = _one_by_one if reach > _LARGE else _at_once
    depth, owner, place = drawn(centre, cell, reach, shape)
    return depth, owner, normals.reshape(-1, 3)[place]


def _at_once(centre: np.ndarray, cell: np.ndarray, reach: int, shape):
    """Many small balls: nearness, owner and place in the cell [h, w]; `cell` is a ball's own nearness."""
    place = np.flatnonzero(np.isfinite(cell))
    rows, columns = np.divmod(place, len(cell))
    column = np.round(centre[:, 0]).astype(int)[:, None] + columns - reach
    row = np.round(centre[:, 1]).astype(int)[:, None] + rows - reach
    seen = (column >= 0) & (column < shape[1]) & (row >= 0) & (row < shape[0])
    index, nearness = (row * shape[1] + column)[seen], (centre[:, 2:] + cell.ravel()[place])[seen]
    nearest = np.full(shape[0] * shape[1], -np.inf, np.float32)
    nearness = nearness.astype(np.float32)
    np.maximum.at(nearest, index, nearness)
    ball, offset = np.nonzero(seen)
    first = np.flatnonzero(nearness == nearest[index])
    owner, places = np.full(nearest.shape, -1), np.zeros(nearest.shape, int)
    owner[index[first]], places[index[first]] = ball[first], place[offset[first]]
    return nearest.reshape(shape), owner.reshape(shape), places.reshape(shape)


def _one_by_one(centre: np.ndarray, cell: np.ndarray, reach: int, shape):
    """Few large balls; as `_at_once`."""
    size, wide = len(cell), 2 * reach
    depth = np.full((shape[0] + 2 * wide, shape[1] + 2 * wide), -np.inf, np.float32)
    owner, places = np.full(depth.shape, -1), np.zeros(depth.shape, int)
    at = np.arange(size * size).reshape(size, size)
    for ball, (column, row, nearness) in enumerate(centre):
        left, top = round(column) - reach + wide, round(row) - reach + wide
        if min(left, top) < 0 or left + size > depth.shape[1] or top + size > depth.shape[0]:
            continue  # beyond the picture
        part = slice(top, top + size), slice(left, left + size)
        nearer = cell + np.float32(nearness) > depth[part]
        depth[part][nearer] = cell[nearer] + np.float32(nearness)
        owner[part][nearer], places[part][nearer] = ball, at[nearer]
    inner = slice(wide, wide + shape[0]), slice(wide, wide + shape[1])
    return depth[inner], owner[inner], places[inner]


def _occlusion(covered: np.ndarray, depth: np.ndarray, radius: float, scale: float) -> np.ndarray:
    """Brightness left to each pixel: less where it lies behind what is about it, near and far.

    Unsharp masking of the depth buffer (Luft, Colditz, Deussen 2006), at two reaches. The background takes no
    part.
    """
    weight, shade = covered.astype(np.float32), np.zeros(covered.shape, np.float32)
    for radii in _OCCLUDED:
        reach = radii * radius
        around = _blurred(depth * weight, reach * scale) / np.maximum(_blurred(weight, reach * scale), 0.02)
        shade += np.clip((around - depth) / (0.6 * reach), 0, 1) / len(_OCCLUDED)
    return 1 - _OCCLUSION * shade


def _blurred(image: np.ndarray, reach: float) -> np.ndarray:
    """An image blurred over about `reach` pixels; nothing lies beyond its edges."""
    size = max(3, round(2 * reach))
    return uniform_filter(uniform_filter(image, size, mode="constant"), size, mode="constant")
