"""The closed surface of a body of points, as triangles, which a page draws in place of grains."""

import numpy as np
from scipy.spatial import Delaunay

_ALPHA = 1.6  # largest circumradius of a tetrahedron inside the body, over the spacing of its points
_MOST = 20_000  # points, of which the tetrahedra take a second
#: Stretch of edges beyond which grains are drawn: a body that flows or tears is no surface of what it was.
_STRETCH = 2.0
_SHARE = 99.5  # [%] percentile of the stretch that counts


def surface(X: np.ndarray, spacing: float, frames: np.ndarray) -> dict[str, np.ndarray]:
    """The surface of a body, as a page has it; nothing where it flows or tears, or has too many points.

    Args:
        X: [n, 3] points at rest [m].
        spacing: edge of the cube that each of them fills [m].
        frames: [F, n, 3] the points as they move [m].

    Returns:
        `corners`: rows [V] of X; `faces`: triangles [m, 3] of these, anticlockwise as seen from outside.

    Source: the boundary of the alpha complex, Edelsbrunner and Mücke 1994.
    """
    if not 4 < len(X) <= _MOST:
        return {}
    faces = boundary(X.astype(float), _ALPHA * spacing)
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    if not len(edges):
        return {}
    rest, lengths = (
        np.linalg.norm(x[..., edges[:, 0], :] - x[..., edges[:, 1], :], axis=-1) for x in (X, frames)
    )
    if not np.percentile(lengths / rest, _SHARE) <= _STRETCH:  # nor of a run that is lost
        return {}
    rows, corners = np.unique(faces, return_inverse=True)
    return {"corners": rows.astype(np.uint16), "faces": corners.reshape(-1, 3).astype(np.uint16)}


def boundary(X: np.ndarray, radius: float) -> np.ndarray:
    """[m, 3] triangles about all Delaunay tetrahedra of points X [n, 3] of at most a circumradius [m]."""
    tetrahedra = Delaunay(X).simplices
    first, *others = np.moveaxis(X[tetrahedra], 1, 0)
    edges = np.stack([other - first for other in others], axis=1)
    flat = np.abs(np.linalg.det(edges)) <= 1e-9 * np.linalg.norm(edges, axis=2).prod(axis=1)
    edges[flat] = np.eye(3)
    centre = np.linalg.solve(edges, 0.5 * (edges**2).sum(axis=2)[..., None])[..., 0]
    inside = tetrahedra[~flat & (np.linalg.norm(centre, axis=1) <= radius)]
    sides = np.concatenate([inside[:, others] for others in ((1, 2, 3), (0, 3, 2), (0, 1, 3), (0, 2, 1))])
    opposite = np.concatenate(list(inside.T))
    _, at, count = np.unique(np.sort(sides, axis=1), axis=0, return_index=True, return_counts=True)
    sides, opposite = sides[at[count == 1]], opposite[at[count == 1]]
    a, b, c = np.moveaxis(X[sides], 1, 0)
    inward = ((X[opposite] - a) * np.cross(b - a, c - a)).sum(axis=1) > 0
    sides[inward] = sides[inward][:, ::-1]
    return sides


def at_surface(X: np.ndarray) -> np.ndarray:
    """[P] whether particles X [P, 3] lie in a cell that has an empty one beside it."""
    extent = np.maximum(np.ptp(X, axis=0), 1e-9)
    edge = 2.0 * (np.prod(extent) / len(X)) ** (1 / 3)  # some eight particles where they fill their box
    cells = np.floor((X - X.min(0)) / edge).astype(int) + 1
    filled = np.zeros(cells.max(0) + 2, bool)
    filled[tuple(cells.T)] = True
    sides = np.concatenate([np.eye(3, dtype=int), -np.eye(3, dtype=int)])
    return np.any([~filled[tuple((cells + side).T)] for side in sides], axis=0)
