"""How well the grid and the particles resolve the bodies of a scene: warnings, which refuse nothing."""

import functools

import numpy as np
from scipy.ndimage import distance_transform_edt, maximum_filter

from nsf.scenes.body import Placing, points_of
from nsf.scenes.checks import depth_in_walls
from nsf.scenes.scene import Scene
from nsf.scenes.shapes.geometry import Shape

#: Cells across the thinnest part of a body, and particles in a cell, below which it is warned of.
LEAST_CELLS, LEAST_PARTICLES = 2.0, 4.0
# A thickness is found to a few percent, mostly from below.
_LENIENT = 0.95
# Points of the lattice on which thin parts are looked for, and its points a cell if they are fewer.
_LATTICE, _FINEST = 2**17, 24
# A point in the middle of a thin part is as deep as all about it, within its depth and a half and as many
# points of the lattice, but for a fifth; towards an edge or a tip it is not, if they are blunter than 30°.
_ABOUT, _AS_DEEP = 1.5, 1.2
# Middles and directions in which the part is measured there; a direction is at most 15° from one of them.
_MIDDLES, _DIRECTIONS = 32, 32


def resolution_warnings(scene: Scene) -> list[str]:
    """Warnings of a scene that is too coarse to be trusted, a line each, with the value that would do."""
    found = []
    for name, body in scene.bodies.items():
        key, volume = f"scene.bodies.{name}", body.shape.volume
        thickness = _thinnest_part(body.placing, scene.dx)
        if thickness < _LENIENT * LEAST_CELLS * scene.dx:
            dx = float(f"{0.98 * thickness / LEAST_CELLS:.2g}")
            needed = max(body.particles, np.ceil(LEAST_PARTICLES * volume / dx**3))
            found.append(
                f"{key}: its thinnest part is {thickness:.2g} m, {thickness / scene.dx:.2g} cells across, "
                "and stiffens or falls apart by the grid, not by its material; "
                f"set scene.dx={dx:g} or finer, dt in proportion, and at least {needed:.0f} particles"
            )
        cells = volume / scene.dx**3
        if body.particles < _LENIENT * LEAST_PARTICLES * cells:
            found.append(
                f"{key}: {body.particles} particles are {body.particles / cells:.2g} a cell, and gaps open "
                f"between them; set {key}.particles={np.ceil(LEAST_PARTICLES * cells):.0f} or more, "
                f"or particles_per_cell={LEAST_PARTICLES:g}"
            )
        held = (depth_in_walls(scene, body.points()) > 0.0).mean()
        if held:
            found.append(
                f"{key}: {100 * held:.2g} % of its particles lie in scene.walls.padding="
                f"{scene.walls.padding} nodes of the edge, where the walls hold them; move it inwards"
            )
    return found


def thinnest(scene: Scene) -> dict[str, float]:
    """Thickness [m] of the thinnest part of each body, to a few percent; infinite if two cells or more."""
    return {name: _thinnest_part(body.placing, scene.dx) for name, body in scene.bodies.items()}


@functools.lru_cache(maxsize=8)
def _thinnest_part(placing: Placing, dx: float) -> float:
    return thinnest_part(placing.shape, dx, points_of(placing))


def thinnest_part(shape: Shape, dx: float, points: np.ndarray) -> float:
    """Thickness [m] of the thinnest part of a shape, to a few percent; infinite if two cells or more.

    The middles of thin parts are found on a lattice, as points whose distance from the surface is the largest
    about them; the thickness is that of the shortest straight line through a middle. A part thinner than the
    lattice, a 50th of the bounding box, may be missed.

    Args:
        shape: known by what it contains alone.
        dx: grid spacing [m].
        points: [n, 3] some that it contains [m], where the lattice hits none.
    """
    lower, upper = shape.bounds
    spacing = max(dx / _FINEST, float(np.prod(upper - lower) / _LATTICE) ** (1 / 3))
    n = np.maximum(1, np.rint((upper - lower) / spacing)).astype(int)
    step = (upper - lower) / n
    x = lower + step * (np.indices(n).reshape(3, -1).T + 0.5)
    inside = shape.contains(x).reshape(n)
    if not inside.any():
        return _thickness(shape, points[:_MIDDLES], np.zeros(len(points[:_MIDDLES])), step.max())
    depth = distance_transform_edt(np.pad(inside, 1), sampling=step)[1:-1, 1:-1, 1:-1] - 0.5 * step.min()
    within = inside & (depth <= 0.5 * LEAST_CELLS * dx)
    about = np.ceil(_ABOUT * (depth / step.min() + 1.0)).astype(int)
    middle = np.zeros(n, bool)
    for reach in np.unique(about[within]):
        deepest = maximum_filter(depth, 2 * reach + 1)
        middle |= within & (about == reach) & (deepest <= _AS_DEEP * depth)
    if not middle.any():
        return np.inf
    chosen = middle & (depth <= 1.15 * depth[middle].min() + 0.5 * step.min())
    some = np.unique(np.linspace(0, chosen.sum() - 1, _MIDDLES).astype(int))
    return _thickness(shape, x[chosen.ravel()][some], depth[chosen][some], step.max())


def _thickness(shape: Shape, middles: np.ndarray, depth: np.ndarray, step: float) -> float:
    """Lower quartile of the shortest lines [m] through points [n, 3] that are `depth` [n] [m] deep."""
    k = np.arange(_DIRECTIONS)
    z, around = 1.0 - (k + 0.5) / _DIRECTIONS, np.pi * (3.0 - 5.0**0.5) * k
    ring = np.sqrt(1.0 - z**2)
    half = np.concatenate([np.eye(3), np.stack([ring * np.cos(around), ring * np.sin(around), z], 1)])
    directions = np.concatenate([half, -half])

    def holds(length: np.ndarray) -> np.ndarray:
        """[n, directions] whether the shape reaches so far from the middles."""
        x = middles[:, None] + length[..., None] * directions
        return shape.contains(x.reshape(-1, 3)).reshape(length.shape)

    first = np.broadcast_to((depth + step)[:, None], (len(middles), len(directions))) / 4.0
    low, high, open_ = np.zeros_like(first), first.copy(), np.ones(first.shape, bool)
    for _ in range(12):
        open_ &= holds(high)
        low, high = np.where(open_, high, low), np.where(open_, high + first, high)
    for _ in range(5):
        tried = 0.5 * (low + high)
        held = holds(tried)
        low, high = np.where(held, tried, low), np.where(held, high, tried)
    return float(np.quantile((low[:, : len(half)] + low[:, len(half) :]).min(1), 0.25))
