"""An orthographic camera that draws particles as shaded spheres into an array of pixels; z is up."""

from dataclasses import dataclass

import numpy as np
from PIL import Image, ImageFilter

_LIGHT = np.array([-0.45, 0.65, 0.62])  # in camera axes: from the upper left, in front
_AMBIENT = 0.72  # share of a sphere's colour that light does not model: keeps the colour map readable
_OCCLUSION = 0.40  # how much nearer surroundings darken what lies behind them
_FLOOR, _FLOOR_EDGE, _SHADOW = 0.945, 0.80, 0.20
_GLAZE = 0.09  # white mixed in, so that the dark end of a colour map still shows its shape
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
    """A camera's window: `low`, `high` [m] in right and up, `width` [pixel], an optional floor height [m]."""

    camera: Camera
    low: np.ndarray
    high: np.ndarray
    width: int
    floor: float | None = None

    @classmethod
    def around(
        cls, x: np.ndarray, width: int, floor: float | None = None, camera: Camera | None = None
    ) -> "View":
        """The window that holds every point of x [..., 3], and a margin of the floor about them."""
        points = x.reshape(-1, 3)
        points = points[np.isfinite(points).all(axis=1)]
        camera = camera or Camera.facing(points)
        flat = camera.project(points)[:, :2]
        low, high = flat.min(axis=0), flat.max(axis=0)
        margin = 0.07 * max(high - low)
        # Twice the margin below, where the length scale stands.
        return cls(camera, low - margin * np.array([1.0, 2.0]), high + margin, width, floor)

    @property
    def height(self) -> int:
        """Pixels upward."""
        extent = self.high - self.low
        return max(8, round(self.width * extent[1] / extent[0]))

    @property
    def metres_across(self) -> float:
        """Width of the window [m]."""
        return float(self.high[0] - self.low[0])

    def picture(self, x: np.ndarray, colors: np.ndarray, radius: float) -> np.ndarray:
        """Particles x [n,3] m as shaded spheres of colors [n,3] in 0..1: pixels [height,width,3], 8 bits.

        Particles that are not finite are left out.
        """
        scale = self.width * _OVERSAMPLE / self.metres_across
        shape = (self.height * _OVERSAMPLE, self.width * _OVERSAMPLE)
        alive = np.isfinite(x).all(axis=1)
        canvas = self._ground(x[alive], radius, scale, shape)
        index, depth, tone, owner = _spheres(
            self._pixels(self.camera.project(x[alive]), scale), radius, scale, shape
        )
        front = _foremost(index, depth, shape[0] * shape[1])
        covered = front >= 0
        front = front[covered]
        if len(front):
            shade = tone[front] * _occlusion(covered.reshape(shape), depth[front], reach=3 * radius * scale)
            canvas.reshape(-1, 3)[covered] = (_GLAZE + (1 - _GLAZE) * colors[alive][owner[front]]) * shade[
                :, None
            ]
        fine = canvas.reshape(self.height, _OVERSAMPLE, self.width, _OVERSAMPLE, 3)
        return (255 * np.clip(fine.mean(axis=(1, 3)), 0, 1)).astype(np.uint8)

    def front(self, x: np.ndarray, radius: float) -> np.ndarray:
        """Rows of the particles x [n, 3] m within three radii [m] of the foremost about them.

        The others are hidden behind these; of millions it leaves those that a picture shows.
        """
        alive = np.flatnonzero(np.isfinite(x).all(axis=1))
        right, up, toward = self.camera.project(x[alive]).T
        columns = int((right.max() - right.min()) / radius) + 1
        cell = ((up - up.min()) / radius).astype(int) * columns + ((right - right.min()) / radius).astype(int)
        foremost = np.full(cell.max() + 1, -np.inf)
        np.maximum.at(foremost, cell, toward)
        return alive[toward >= foremost[cell] - 3.0 * radius]

    def _pixels(self, projected: np.ndarray, scale: float) -> np.ndarray:
        """Camera axes [m] to column, row [pixel] and nearness [m]."""
        column = (projected[:, 0] - self.low[0]) * scale
        row = (self.high[1] - projected[:, 1]) * scale
        return np.stack([column, row, projected[:, 2]], axis=1)

    def _ground(self, x: np.ndarray, radius: float, scale: float, shape) -> np.ndarray:
        """White, the floor as a band up to its horizon line, and the shadow of the particles on it."""
        canvas = np.ones((*shape, 3), np.float32)
        if self.floor is None or not len(x):
            return canvas
        _, up, toward = self.camera.axes
        middle = 0.5 * (np.quantile(x[:, :2], 0.01, axis=0) + np.quantile(x[:, :2], 0.99, axis=0))
        behind = middle - toward[:2] / np.hypot(*toward[:2]) * 0.33 * self.metres_across
        horizon = int((self.high[1] - np.append(behind, self.floor) @ up) * scale)
        horizon = int(np.clip(horizon, 0, shape[0]))
        canvas[horizon:] = _FLOOR
        canvas[horizon : horizon + _OVERSAMPLE] = _FLOOR_EDGE
        light = _LIGHT @ self.camera.axes
        fallen = x - (x[:, 2:] - self.floor) / light[2] * light
        index, *_ = _spheres(
            self._pixels(self.camera.project(fallen), scale), radius, scale, shape, squash=0.35
        )
        shadow = np.zeros(shape, np.float32)
        shadow.reshape(-1)[index] = 1.0
        shadow[:horizon] = 0.0
        canvas *= 1 - _SHADOW * _blurred(shadow, radius * scale)[..., None]
        return canvas


def _spheres(centre: np.ndarray, radius: float, scale: float, shape, squash: float = 1.0):
    """Pixels that spheres cover: flat index, nearness [m], brightness, and the particle each belongs to."""
    pixels = max(radius * scale, 0.8)
    reach = int(np.ceil(pixels))
    dx, dy = np.meshgrid(np.arange(-reach, reach + 1), np.arange(-reach, reach + 1))
    inside = dx**2 + (dy / squash) ** 2 <= pixels**2
    dx, dy = dx[inside], dy[inside]
    bulge = np.sqrt(np.maximum(0.0, 1 - (dx**2 + dy**2) / pixels**2))
    light = _LIGHT / np.linalg.norm(_LIGHT)
    facing = np.maximum(0.0, (dx * light[0] - dy * light[1]) / pixels + bulge * light[2])
    tone = _AMBIENT + (1 - _AMBIENT) * facing
    column = np.round(centre[:, 0]).astype(int)[:, None] + dx
    row = np.round(centre[:, 1]).astype(int)[:, None] + dy
    seen = (column >= 0) & (column < shape[1]) & (row >= 0) & (row < shape[0])
    depth = centre[:, 2:3] + bulge * radius
    owner = np.broadcast_to(np.arange(len(centre))[:, None], seen.shape)
    return (row * shape[1] + column)[seen], depth[seen], np.broadcast_to(tone, seen.shape)[seen], owner[seen]


def _foremost(index: np.ndarray, depth: np.ndarray, pixels: int) -> np.ndarray:
    """Of each pixel the entry nearest to the viewer, the last of equal ones; -1 where there is none."""
    nearest = np.full(pixels, -np.inf)
    np.maximum.at(nearest, index, depth)
    seen = np.flatnonzero(depth == nearest[index])
    front = np.full(pixels, -1)
    front[index[seen]] = seen
    return front


def _occlusion(covered: np.ndarray, depth: np.ndarray, reach: float) -> np.ndarray:
    """Brightness left to each covered pixel: less where it lies behind what is `reach` pixels about.

    Unsharp masking of the depth buffer (Luft, Colditz, Deussen 2006). The background takes no part.
    """
    nearness = (depth - depth.min()) / max(np.ptp(depth), 1e-12)
    buffer = np.zeros(covered.shape, np.float32)
    buffer[covered] = nearness
    around = _blurred(buffer, reach)[covered] / np.maximum(_blurred(covered, reach)[covered], 0.02)
    return 1 - _OCCLUSION * np.clip(6 * (around - nearness), 0, 1)


def _blurred(image: np.ndarray, reach: float) -> np.ndarray:
    """A picture of values in 0..1 blurred over `reach` pixels, in 8 bits: enough for shading, and fast."""
    picture = Image.fromarray((255 * image.astype(np.float32)).astype(np.uint8))
    return np.asarray(picture.filter(ImageFilter.GaussianBlur(float(reach))), np.float32) / 255
