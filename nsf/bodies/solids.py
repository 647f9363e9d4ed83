"""Colliders in pictures, as faces that a camera draws, in axes in which gravity points down."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

_STEEL, _GROUND = np.array([0.42, 0.47, 0.54]), np.array([0.955, 0.955, 0.955])
_CLEAR = 0.34  # share of a solid's own colour: what it covers shows through
_LIGHT = np.array([-0.35, -0.55, 0.75])
_SHADE = 0.16  # how much darker a face is that the light does not meet
_BESIDE, _THICK = 0.06, 0.015  # of the body's extent: how far the ground goes on about it, how thick it is
_ROUND = 48  # corners of a sphere's outline


@dataclass(frozen=True)
class Face:
    """A flat face: corners [k, 3] [m] in order, color [3] in 0..1, opacity, whether shadows fall on it."""

    corners: np.ndarray
    color: np.ndarray
    opacity: float = 1.0
    ground: bool = False

    @property
    def normal(self) -> np.ndarray:
        """Unit vector across it."""
        across = np.cross(self.corners[1] - self.corners[0], self.corners[2] - self.corners[1])
        return across / np.linalg.norm(across)


class Solids:
    """The colliders about a body over time, in axes whose z is up: a scene may be that of an inclined plane.

    Args:
        around: gravity and colliders, as `nsf.evaluation.surroundings` returns them; empty for none.
        centre: [3] [m] about which the scene is turned upright.

    Attributes:
        reached: of each collider how far bodies come in its axes, lowest and highest [2, 3] [m]; so much of
            a half-space is drawn.
    """

    def __init__(self, around: Mapping[str, np.ndarray], centre: np.ndarray):
        self._around, self._centre, self.reached = around, centre, []
        self._turn = upright(around["gravity"][0].astype(float)) if around else np.eye(3)

    def turned(self, x: np.ndarray) -> np.ndarray:
        """Points x [..., 3] [m] with z up."""
        return (x - self._centre) @ self._turn.T + self._centre

    def reach(self, bodies: Sequence[np.ndarray]) -> list[np.ndarray]:
        """How far points [n, 3] of each body, with z up, come in the axes of each collider at first."""
        boxes = []
        for c in range(len(self._around.get("solid_shape", ()))):
            placed = [x @ self._axes(0, c) for x in bodies]
            ends = np.array([(np.nanmin(x, axis=0), np.nanmax(x, axis=0)) for x in placed])
            boxes.append(np.stack([ends[:, 0].min(axis=0), ends[:, 1].max(axis=0)]))
        return boxes

    def faces(self, frame: int, toward: np.ndarray) -> list[Face]:
        """The colliders in a frame, as a viewer in the direction `toward` [3] sees them."""
        around = self._around
        faces: list[Face] = []
        for c in np.flatnonzero(around["solid_active"][frame]) if around else ():
            position, shape = self.turned(around["solid_position"][frame, c]), str(around["solid_shape"][c])
            axes, extents = self._axes(frame, c), around["solid_extents"][c]
            if shape == "half-space":
                faces += _slab(self.reached[c], position, axes, toward)
            elif shape == "cuboid":
                faces += _box(position, axes * extents, toward, _STEEL, _CLEAR)
            else:
                faces.append(_disc(position, float(extents[0]), toward))
        return faces

    def _axes(self, frame: int, c: int) -> np.ndarray:
        """A collider's axes as columns [3, 3]; the last of a half-space is its normal."""
        turn = self._turn @ self._around["solid_orientation"][frame, c].astype(float)
        if str(self._around["solid_shape"][c]) != "half-space":
            return turn
        normal = self._around["solid_extents"][c].astype(float)
        along = np.eye(3)[0 if abs(normal[0]) < 0.9 else 1]
        u = along - (along @ normal) * normal
        u /= np.linalg.norm(u)
        return turn @ np.stack([u, np.cross(normal, u), normal], axis=1)


def upright(gravity: np.ndarray) -> np.ndarray:
    """The rotation [3, 3] that lets gravity [3] point down, by the shortest way; none without gravity."""
    size = float(np.linalg.norm(gravity))
    if size == 0.0 or gravity[2] <= -0.9999 * size:
        return np.eye(3)
    up, z = -gravity / size, np.array([0.0, 0.0, 1.0])
    axis, cos = np.cross(up, z), float(up @ z)
    if cos < -0.9999:
        return np.diag([1.0, -1.0, -1.0])
    K = np.array([[0.0, -axis[2], axis[1]], [axis[2], 0.0, -axis[0]], [-axis[1], axis[0], 0.0]])
    return np.eye(3) + K + K @ K / (1.0 + cos)


def _slab(reach: np.ndarray, point: np.ndarray, axes: np.ndarray, toward: np.ndarray) -> list[Face]:
    """The part of a half-space beneath bodies; nothing where it lies before them."""
    normal = axes[:, 2]
    if normal @ toward < 0.05:
        return []
    margin = _BESIDE * max(reach[1] - reach[0])
    low, high = reach[0] - margin, reach[1] + margin
    top = float(point @ normal)
    low[2], high[2] = min(top - _THICK / _BESIDE * margin, reach[0, 2]), top
    centre, half = axes @ (0.5 * (low + high)), 0.5 * (high - low)
    faces = _box(centre, axes * half, toward, _GROUND, 1.0)
    return [replace(face, ground=bool(face.normal @ normal > 0.99)) for face in faces]


def _box(centre, half: np.ndarray, toward, color: np.ndarray, opacity: float) -> list[Face]:
    """The faces of a box that the viewer sees; `half` [3, 3]: its half edges as columns."""
    light = _LIGHT / np.linalg.norm(_LIGHT)
    faces = []
    for out, a, b in _sides(half):
        if out @ toward <= 0.0:
            continue
        corners = np.stack([out + sa * a + sb * b for sa, sb in ((-1, -1), (1, -1), (1, 1), (-1, 1))])
        lit = max(0.0, float(out @ light) / np.linalg.norm(out))
        faces.append(Face(centre + corners, color * (1 - _SHADE * (1 - lit)), opacity))
    return faces


def _sides(half: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Of each side of a box the way out, and two edges that turn right-handed about it."""
    for k in range(3):
        out, a, b = half[:, k], half[:, (k + 1) % 3], half[:, (k + 2) % 3]
        yield out, a, b
        yield -out, b, a


def _disc(centre: np.ndarray, radius: float, toward: np.ndarray) -> Face:
    """A sphere as its outline."""
    right = np.cross([0.0, 0.0, 1.0], toward)
    right /= np.linalg.norm(right)
    up = np.cross(toward, right)
    angle = np.linspace(0.0, 2.0 * np.pi, _ROUND, endpoint=False)[:, None]
    return Face(centre + radius * (np.cos(angle) * right + np.sin(angle) * up), _STEEL, _CLEAR)
