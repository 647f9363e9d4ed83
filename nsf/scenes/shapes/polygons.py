"""Triangles of polygons, by fans where those fit and else by ear clipping."""

import numpy as np

# Polygons that are looked at together: some 100 MB.
_PORTION = 2**18
# Rounding of a fan's areas, in units of their sum.
_ROUNDING = 1e-9
# A polygon with so many corners takes a second to clip.
MAX_CORNERS = 4096


class CrossingError(ValueError):
    """A polygon has no triangles, as its edges cross; `corners` is their number."""

    def __init__(self, corners: int):
        super().__init__(corners)
        self.corners = corners


def triangulated(vertices: np.ndarray, corners: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """[T, 3] triangles over the same vertices, turned as their polygons are.

    Args:
        vertices: [V, 3], finite.
        corners: [C] vertices of one polygon after the other.
        sizes: [F] number of corners of each, at least 3.

    Raises:
        CrossingError: a polygon crosses itself, or is concave with more corners than `MAX_CORNERS`.
    """
    triangles, starts = [], np.cumsum(sizes) - sizes
    for size in np.unique(sizes):
        start = starts[sizes == size]
        for k in range(0, len(start), _PORTION):
            polygons = corners[start[k : k + _PORTION, None] + np.arange(size)]
            triangles.append(polygons if size == 3 else _of_one_size(vertices, polygons))
    return np.concatenate(triangles)


def _of_one_size(vertices: np.ndarray, polygons: np.ndarray) -> np.ndarray:
    """[T, 3] triangles of polygons [F, n]."""
    fits = _fans_fit(vertices[polygons])
    triangles = [_fans(polygons[fits])]
    polygons = polygons[~fits]
    if polygons.shape[1] == 4:  # of a concave quad one diagonal fits
        polygons = np.roll(polygons, 1, axis=1)
        fits = _fans_fit(vertices[polygons])
        triangles.append(_fans(polygons[fits]))
        polygons = polygons[~fits]
    for polygon in polygons:
        triangles.append(polygon[_clipped(_flattened(vertices[polygon]))])
    return np.concatenate(triangles)


def _fans(polygons: np.ndarray) -> np.ndarray:
    """[F (n − 2), 3] triangles between the first corner and each edge that it does not touch."""
    n = polygons.shape[1]
    return np.stack([np.repeat(polygons[:, :1], n - 2, 1), polygons[:, 1:-1], polygons[:, 2:]], 2).reshape(
        -1, 3
    )


def _fans_fit(x: np.ndarray) -> np.ndarray:
    """[F] whether a fan's triangles in the polygon with corners x [F, n, 3] all face as the polygon does."""
    with np.errstate(over="ignore", invalid="ignore"):
        arms = x[:, 1:] - x[:, :1]
        areas = np.cross(arms[:, :-1], arms[:, 1:])
        normal, size = areas.sum(1), np.linalg.norm(areas, axis=2).sum(1)
        length = np.linalg.norm(normal, axis=1)
        facing = (areas * normal[:, None]).sum(2) >= -_ROUNDING * (size * length)[:, None]
        flat = size <= 1e-12 * (arms**2).sum((1, 2))
        return flat | (facing.all(1) & (length > 1e-6 * size))


def _flattened(x: np.ndarray) -> np.ndarray:
    """[n, 2] corners without the coordinate along which the polygon is widest, anticlockwise."""
    arms = x[1:] - x[:1]
    normal = np.cross(arms[:-1], arms[1:]).sum(0)
    axis = int(np.abs(normal).argmax())
    plane = x[:, [(axis + 1) % 3, (axis + 2) % 3]]
    return plane if normal[axis] > 0.0 else plane[:, ::-1]


def _clipped(x: np.ndarray) -> np.ndarray:
    """[n − 2, 3] corners of triangles that fill an anticlockwise polygon x [n, 2].

    An ear is a convex corner whose triangle holds no other corner. Where corners lie on one line,
    or a bridge leads to a hole, a triangle without an area is cut off if there is no better one.

    Source: G. H. Meisters 1975, "Polygons have ears".
    """
    if len(x) > MAX_CORNERS:
        raise CrossingError(len(x))
    left, triangles, k, passed = list(range(len(x))), [], 0, 0
    while len(left) > 3:
        if passed >= 2 * len(left):
            raise CrossingError(len(x))
        k %= len(left)
        ear = left[k - 1], left[k], left[(k + 1) % len(left)]
        if _is_ear(x, left, ear, passed >= len(left)):
            triangles.append(ear)
            del left[k]
            passed = 0
        else:
            k, passed = k + 1, passed + 1
    if _turn(*x[left]) < 0.0:
        raise CrossingError(len(x))
    return np.array([*triangles, left])


def _turn(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    """Twice the area of the triangle, or of each, positive where it is anticlockwise."""
    return (b[..., 0] - a[..., 0]) * (c[..., 1] - a[..., 1]) - (b[..., 1] - a[..., 1]) * (
        c[..., 0] - a[..., 0]
    )


def _is_ear(x: np.ndarray, left: list[int], ear: tuple[int, int, int], flat: bool) -> bool:
    a, b, c = x[list(ear)]
    area = _turn(a, b, c)
    if area < 0.0 or (area == 0.0) != flat:
        return False
    others = x[left]
    others = others[~np.any([(others == corner).all(1) for corner in (a, b, c)], axis=0)]
    within = (_turn(a, b, others) >= 0.0) & (_turn(b, c, others) >= 0.0) & (_turn(c, a, others) >= 0.0)
    return flat or not within.any()
