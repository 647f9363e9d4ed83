"""Nonlinear least squares in the unit cube, from the best of many points that are looked at in one batch."""

from collections.abc import Callable
from functools import lru_cache

import numpy as np
import torch
from scipy.optimize import OptimizeResult, least_squares
from scipy.stats import qmc
from torch import Tensor

from nsf.inverse.recurrence import with_jacobian

_POLISHED = 3  # starts that are followed to their end
_LOST = 1e6  # residual of a run that does not stay finite, too large for a step that the solver takes


def nearest(
    seen: Callable[[Tensor], Tensor],
    values: np.ndarray,
    scale: np.ndarray,
    n: int,
    starts: int,
    device: torch.device,
    seed: int = 0,
) -> OptimizeResult | None:
    """The point at which a function comes nearest to values, in units of a scale.

    Args:
        seen: u [B, n] in the unit cube → [B, m], differentiable.
        values, scale: [m].
        n: coordinates of u.
        starts: points that are looked at, spread evenly (Sobol); the best of them, apart from each other,
            are followed by scipy's `least_squares`.
        device: of u; seed: of the starts.

    Returns:
        As `scipy.optimize.least_squares` has it; None where no start gives finite numbers.
    """

    @lru_cache(maxsize=1)  # of values and slopes, which scipy asks for one after the other
    def residuals(u: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
        at, slopes = with_jacobian(seen, torch.tensor([u], dtype=torch.float64, device=device))
        off = (at[0].cpu().numpy() - values) / scale
        slopes = slopes[0].cpu().numpy() / scale[:, None]
        return np.nan_to_num(off, nan=_LOST, posinf=_LOST, neginf=-_LOST), np.nan_to_num(slopes)

    def followed(start: np.ndarray) -> OptimizeResult:
        return least_squares(
            lambda u: residuals(tuple(u))[0], start, jac=lambda u: residuals(tuple(u))[1],
            bounds=(0.0, 1.0), x_scale=1.0, max_nfev=40, xtol=1e-7, ftol=1e-7, gtol=1e-7,
        )  # fmt: skip

    begun = _starts(seen, values, scale, qmc.Sobol(n, seed=seed), starts, device)
    return min(map(followed, begun), key=lambda end: end.cost, default=None)


def _starts(
    seen, values: np.ndarray, scale: np.ndarray, cube: qmc.Sobol, count: int, device: torch.device
) -> list[np.ndarray]:
    """Points [n] of the unit cube with the least residuals, of so many that are evenly spread."""
    points = cube.random_base2(max(0, count - 1).bit_length())[:count]
    with torch.no_grad():
        runs = seen(torch.as_tensor(points, device=device)).cpu().numpy()
    finite = np.isfinite(runs).all(1)
    points, costs = points[finite], np.sum(((runs[finite] - values) / scale) ** 2, axis=1)
    # Those beside a better one would end where it ends.
    reach, chosen = 1.5 * count ** (-1.0 / cube.d), []
    for u in points[np.argsort(costs)]:
        if all(np.abs(u - other).max() > reach for other in chosen):
            chosen.append(u)
    return chosen[:_POLISHED]
