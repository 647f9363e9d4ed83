"""How often a closed surface of triangles winds round a point."""

from collections.abc import Iterator

import numpy as np

# Point-triangle pairs that are looked at together: some 100 MB.
_PAIRS = 2**19
# Triangles a cell in the mean, above which cells are made coarser: bounds the memory of long triangles.
_CROWDED = 32


class WindingNumber:
    """Winding numbers by the signed triangles above a point.

    Along a vertical line each triangle that faces up adds 1 and each that faces down takes 1 off.
    A triangle's projection holds the line or not by half-open crossings of its edges, and an edge
    is evaluated alike for both triangles it belongs to. So no line slips between two triangles or
    is counted twice, through whatever edge or corner it passes; only within rounding of the surface
    is the answer either side's. Triangles are found by columns of a grid in the horizontal plane.

    Args:
        triangles: [F, 3, 3] corners [m] of a closed surface; corners that are one are equal to the bit.

    Source: half-open crossings: Hormann and Agathos 2001, "The point in polygon problem for
    arbitrary polygons".
    """

    def __init__(self, triangles: np.ndarray):
        self.triangles = triangles
        self.lower, self.upper = triangles.min(1), triangles.max(1)
        self.corners = self.lower.min(0), self.upper.max(0)
        cells = int(np.clip(len(triangles) ** 0.5, 1, 1024))
        while cells > 1 and self._spans(cells)[1].prod(1).sum() > _CROWDED * (len(triangles) + cells**2):
            cells //= 2
        self.cells = cells
        first, spans = self._spans(cells)
        counts = spans.prod(1)
        triangle = np.repeat(np.arange(len(triangles)), counts)
        k = np.arange(len(triangle)) - np.repeat(np.cumsum(counts) - counts, counts)
        column, row = first[triangle].T + np.stack(np.divmod(k, spans[triangle, 1]))
        cell = column * cells + row
        self._order = triangle[np.argsort(cell, kind="stable")]
        self._start = np.concatenate([[0], np.cumsum(np.bincount(cell, minlength=cells**2))])

    def _cell_of(self, x: np.ndarray, cells: int) -> np.ndarray:
        """[n, 2] cell of each point's projection; rises with x, so that triangles and points agree."""
        lower, upper = (corner[:2] for corner in self.corners)
        edge = np.maximum((upper - lower) / cells, np.finfo(float).tiny)
        return np.clip(((x[:, :2] - lower) / edge).astype(np.int64), 0, cells - 1)

    def _spans(self, cells: int) -> tuple[np.ndarray, np.ndarray]:
        """First cell of each triangle, and how many it spans, along each axis."""
        first = self._cell_of(self.lower, cells)
        return first, self._cell_of(self.upper, cells) - first + 1

    def of(self, x: np.ndarray) -> np.ndarray:
        """[n] winding numbers of the points x [n, 3] [m]."""
        number = np.zeros(len(x), np.int64)
        lower, upper = self.corners
        near = np.flatnonzero(((x >= lower) & (x <= upper)).all(1))
        for point, triangle in self._pairs(x, near):
            number += self._crossings(x, point, triangle)
        return number

    def _pairs(self, x: np.ndarray, near: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Each point with each triangle of its column, in portions."""
        column, row = self._cell_of(x[near], self.cells).T
        cell = column * self.cells + row
        counts = self._start[cell + 1] - self._start[cell]
        portion = np.cumsum(counts) // _PAIRS
        for n in np.unique(portion):
            some = portion == n
            count = counts[some]
            k = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
            yield np.repeat(near[some], count), self._order[np.repeat(self._start[cell[some]], count) + k]

    def _crossings(self, x: np.ndarray, point: np.ndarray, triangle: np.ndarray) -> np.ndarray:
        """[n] what these pairs add to each point's winding number."""
        p = x[point]
        above = (p <= self.upper[triangle]).all(1) & (p[:, :2] >= self.lower[triangle, :2]).all(1)
        p, point, triangle = p[above], point[above], triangle[above]
        facing = sum(self._edge_crossing(p, triangle, i) for i in range(3))
        hit = np.flatnonzero(facing)
        higher = self._height(p[hit], triangle[hit]) > p[hit, 2]
        hit = hit[higher]
        added = np.bincount(point[hit], weights=facing[hit], minlength=len(x))
        return added.astype(np.int64)

    def _edge_crossing(self, p: np.ndarray, triangle: np.ndarray, i: int) -> np.ndarray:
        """+1 (−1) where the triangle's edge i passes the point upwards (downwards) in y, at larger x."""
        a, b = self.triangles[triangle, i, :2], self.triangles[triangle, (i + 1) % 3, :2]
        rises = a[:, 1] < b[:, 1]
        low, high = np.where(rises[:, None], a, b), np.where(rises[:, None], b, a)
        passes = (low[:, 1] <= p[:, 1]) & (p[:, 1] < high[:, 1])
        run, rise = (high - low).T
        left = run * (p[:, 1] - low[:, 1]) > rise * (p[:, 0] - low[:, 0])
        # Exact beyond the edge's ends, so that triangles whose bounds miss the point add nothing.
        left = (p[:, 0] < np.minimum(low[:, 0], high[:, 0])) | (
            left & (p[:, 0] <= np.maximum(low[:, 0], high[:, 0]))
        )
        return np.where(passes & left, np.where(rises, 1, -1), 0)

    def _height(self, p: np.ndarray, triangle: np.ndarray) -> np.ndarray:
        """z of the triangle's plane above or below p, kept between the triangle's corners.

        Of a triangle that all but stands upright, the height is rounding and p all but on it.
        """
        a, b, c = np.moveaxis(self.triangles[triangle], 1, 0)
        normal = np.cross(b - a, c - a)
        with np.errstate(divide="ignore", invalid="ignore"):
            z = a[:, 2] - ((p[:, :2] - a[:, :2]) * normal[:, :2]).sum(1) / normal[:, 2]
        z = np.where(np.isfinite(z), z, self.upper[triangle, 2])
        return np.clip(z, self.lower[triangle, 2], self.upper[triangle, 2])
