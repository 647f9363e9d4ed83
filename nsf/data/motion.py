"""Whether anything happens to the body in a trajectory, from its first and last frame."""

import numpy as np

#: Of a cell: a motion, and a change of shape, below which nothing happens.
_STILL = 0.01
STILL = "at the end nothing is 1 % of a cell from where it began; set more scene.steps, or a larger load"
RIGID = "the body moves, and deforms by less than 1 % of a cell; set more scene.steps, or a larger load"
FLAT = "the body ends flatter than a cell; give it a stiffer material or a smaller load"


def motion_warnings(X: np.ndarray, x: np.ndarray, dx: float) -> list[str]:
    """One of `STILL`, `RIGID` and `FLAT`, or nothing.

    Args:
        X: [P, 3] positions [m] at rest; x: [P, 3] in the last frame [m].
        dx: grid spacing [m].
    """
    if _farthest(x - X) < _STILL * dx:
        return [STILL]
    if _farthest(x - _moved(X, x)) < _STILL * dx:
        return [RIGID]
    if np.ptp(x, axis=0).min() < dx < 0.5 * np.ptp(X, axis=0).min():
        return [FLAT]
    return []


def _farthest(shifts: np.ndarray) -> float:
    return float(np.linalg.norm(shifts, axis=1).max())


def _moved(X: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Positions at rest under the rigid motion that brings them nearest to x (Kabsch 1976)."""
    middle, end = X.mean(0), x.mean(0)
    U, _, Vt = np.linalg.svd((X - middle).T @ (x - end))
    turn = U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))]) @ Vt
    return (X - middle) @ turn + end
