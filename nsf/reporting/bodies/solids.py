"""Colliders in pictures, as faces that a camera draws, in axes in which gravity points down."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from nsf.reporting.sources import Motion

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


def upright(motion: Motion) -> Motion:
    """The motion in axes whose z is up: a scene may be in the frame of an inclined plane."""
    around = motion.surroundings
    gravity = around["gravity"][0].astype(float) if around else np.zeros(3)
    size = np.linalg.norm(gravity)
    if size == 0.0 or gravity[2] <= -0.9999 * size:
        return motion
    turn = _turn(-gravity / size)
    centre = motion.x_full[0].mean(axis=0, dtype=float)

    def turned(x: np.ndarray) -> np.ndarray:
        return ((x - centre) @ turn.T + centre).astype(np.float32)

    placed = {
        "gravity": around["gravity"] @ turn.T,
        "solid_position": turned(around["solid_position"]),
        "solid_orientation": turn @ around["solid_orientation"],
    }
    return replace(
        motion,
        x_full=turned(motion.x_full),
        x_reduced=turned(motion.x_reduced),
        surroundings={**around, **placed},
    )


def reaches(motions: Sequence[Motion]) -> list[np.ndarray]:
    """How far bodies of upright motions reach in the axes of each collider: lowest and highest [2, 3] [m]."""
    found = []
    for c in range(len(motions[0].surroundings.get("solid_shape", ()))):
        placed = [_axes(m.surroundings, 0, c).T @ m.x_full.reshape(-1, 3).T for m in motions]
        ends = [(x.min(axis=1), x.max(axis=1)) for x in placed]
        found.append(np.stack([np.min([low for low, _ in ends], 0), np.max([high for _, high in ends], 0)]))
    return found


def faces(motion: Motion, frame: int, toward: np.ndarray, reach: Sequence[np.ndarray]) -> list[Face]:
    """What a viewer in the direction `toward` [3] sees of the colliders at a frame of an upright motion.

    `reach` says how much of a half-space is drawn (`reaches`).
    """
    around = motion.surroundings
    found: list[Face] = []
    for c in np.flatnonzero(around["solid_active"][frame]) if around else ():
        position, shape = around["solid_position"][frame, c], str(around["solid_shape"][c])
        axes, extents = _axes(around, frame, c), around["solid_extents"][c]
        if shape == "half-space":
            found += _slab(reach[c], position, axes, toward)
        elif shape == "cuboid":
            found += _box(position, axes * extents, toward, _STEEL, _CLEAR)
        else:
            found.append(_disc(position, float(extents[0]), toward))
    return found


def _axes(around: Mapping[str, np.ndarray], frame: int, c: int) -> np.ndarray:
    """A collider's axes as columns [3, 3]; the last of a half-space is its normal."""
    turn = around["solid_orientation"][frame, c].astype(float)
    if str(around["solid_shape"][c]) != "half-space":
        return turn
    normal = around["solid_extents"][c].astype(float)
    along = np.eye(3)[0 if abs(normal[0]) < 0.9 else 1]
    u = along - (along @ normal) * normal
    u /= np.linalg.norm(u)
    return turn @ np.stack([u, np.cross(normal, u), normal], axis=1)


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
    found = _box(centre, axes * half, toward, _GROUND, 1.0)
    return [replace(face, ground=bool(face.normal @ normal > 0.99)) for face in found]


def _box(centre, half: np.ndarray, toward, color: np.ndarray, opacity: float) -> list[Face]:
    """The faces of a box that the viewer sees; `half` [3, 3]: its half edges as columns."""
    light = _LIGHT / np.linalg.norm(_LIGHT)
    found = []
    for out, a, b in _sides(half):
        if out @ toward <= 0.0:
            continue
        corners = np.stack([out + sa * a + sb * b for sa, sb in ((-1, -1), (1, -1), (1, 1), (-1, 1))])
        lit = max(0.0, float(out @ light) / np.linalg.norm(out))
        found.append(Face(centre + corners, color * (1 - _SHADE * (1 - lit)), opacity))
    return found


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


def _turn(up: np.ndarray) -> np.ndarray:
    """The rotation [3, 3] that takes a unit vector to z by the shortest way."""
    z = np.array([0.0, 0.0, 1.0])
    axis, cos = np.cross(up, z), float(up @ z)
    if cos < -0.9999:
        return np.diag([1.0, -1.0, -1.0])
    K = np.array([[0.0, -axis[2], axis[1]], [axis[2], 0.0, -axis[0]], [-axis[1], axis[0], 0.0]])
    return np.eye(3) + K + K @ K / (1.0 + cos)
