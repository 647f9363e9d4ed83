"""The start and the forcing of a run, as polynomials of the problem parameters.

A parameter may change the initial velocity, gravity or the motion of a solid. It does so through the
scene's configuration, which knows no gradient. A few scenes at chosen values tell the polynomial, and others
that it holds.
"""

import itertools
from collections.abc import Callable, Sequence
from typing import NoReturn

import numpy as np
import torch
from numpy.polynomial import chebyshev
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from nsf.errors import ConfigError

#: Degrees that are tried in turn: a velocity is linear in its speed, a direction takes more of its angle.
_DEGREES = (1, 2, 4, 8, 12)
_SAME = 1e-9  # of the largest value, by how much a polynomial may be off
_COMPARED = (0.137, 0.529, 0.871)  # where it is compared, in units of the ranges


class Polynomial:
    """An array as a polynomial of the problem parameters.

    Each parameter that changes the array has the degree that it takes by itself. Parameters whose changes
    add up have terms apart, so that the scenes that are built grow with their number and no faster; only
    those that act together, as a speed and its direction, have products of terms.

    Args:
        of: parameters [n] → array.
        ranges: [n, 2] of the parameters.
        names: of the parameters and of the array, for messages.

    Attributes:
        varies: whether any parameter changes the array.

    Raises:
        ConfigError: no polynomial comes near it.
    """

    def __init__(
        self, of: Callable[[np.ndarray], np.ndarray], ranges: np.ndarray, names: tuple[Sequence[str], str]
    ):
        self._ranges, self._of, self._names = np.asarray(ranges, float), of, names
        base = np.asarray(of(self._ranges.mean(1)), float)
        self._shape, self._base = base.shape, torch.as_tensor(base.ravel())
        one = {p: self._change({p: _COMPARED[0]}) for p in range(len(ranges))}
        along = [p for p, change in one.items() if change.any()]
        self.varies, self._terms = bool(along), []
        if not along:
            return
        compared = [dict.fromkeys(along, u) for u in _COMPARED]
        truth = torch.stack([self._change(place) for place in compared])
        largest = max(float((truth + self._base).abs().max()), float(self._base.abs().max()))
        self._slack = _SAME * largest
        degrees = {p: self._degree(p) for p in along}
        self._terms = [self._term(group, degrees) for group in self._groups(along, one)]
        if (self._sum(self._units(compared)) - truth).abs().max() > self._slack:
            self._refuse(along)

    def to(self, device: torch.device) -> "Polynomial":
        """Itself, with all it holds on a device."""
        self._base = self._base.to(device)
        self._terms = [(degrees, coefficients.to(device)) for degrees, coefficients in self._terms]
        return self

    def __call__(self, parameters: Tensor) -> Tensor:
        """The array [..., *shape] at parameters [..., n]; [*shape] where none changes it."""
        if not self.varies:
            return self._base.view(self._shape)
        low, high = torch.as_tensor(self._ranges.T).to(parameters)
        return (self._base + self._sum((parameters - low) / (high - low))).unflatten(-1, self._shape)

    def _sum(self, u: Tensor) -> Tensor:
        """Change [..., size] from the middle at parameters u [..., n] in units of their ranges."""
        return sum(_products(u, degrees) @ coefficients for degrees, coefficients in self._terms)

    def _units(self, places: Sequence[dict[int, float]]) -> Tensor:
        """u [places, n]: the middle of the ranges, but for some parameters."""
        rows = [[place.get(p, 0.5) for p in range(len(self._ranges))] for place in places]
        return torch.tensor(rows, dtype=torch.float64)

    def _change(self, place: dict[int, float]) -> Tensor:
        """[size] of the array itself at a place, less that in the middle."""
        low, high = self._ranges.T
        mu = low + self._units([place])[0].numpy() * (high - low)
        return torch.as_tensor(np.ravel(np.asarray(self._of(mu), float))) - self._base

    def _degree(self, p: int) -> int:
        """The least degree that follows a parameter by itself."""
        compared = [{p: u} for u in _COMPARED]
        truth = torch.stack([self._change(place) for place in compared])
        for degree in _DEGREES:
            degrees, coefficients = self._term([p], {p: degree})
            off = _products(self._units(compared), degrees) @ coefficients - truth
            if float(off.abs().max()) <= self._slack:
                return degree
        self._refuse([p])

    def _term(self, group: Sequence[int], degrees: dict[int, int]) -> tuple[dict[int, int], Tensor]:
        """Degrees of some parameters, and coefficients [products, size] of what they change together."""
        chosen = {p: degrees[p] for p in group}
        nodes = [0.5 + 0.5 * chebyshev.chebpts1(degree + 1) for degree in chosen.values()]
        places = [dict(zip(chosen, us, strict=True)) for us in itertools.product(*nodes)]
        change = torch.stack([self._change(place) for place in places])
        return chosen, torch.linalg.solve(_products(self._units(places), chosen), change)

    def _groups(self, along: Sequence[int], one: dict[int, Tensor]) -> list[list[int]]:
        """Parameters that act together: what two change at once is not what each changes by itself."""
        together = np.eye(len(along), dtype=bool)
        for (i, p), (j, other) in itertools.combinations(enumerate(along), 2):
            both = self._change({p: _COMPARED[0], other: _COMPARED[0]})
            together[i, j] = float((both - one[p] - one[other]).abs().max()) > self._slack
        count, label = connected_components(together, directed=False)
        return [[p for p, part in zip(along, label, strict=True) if part == k] for k in range(count)]

    def _refuse(self, along: Sequence[int]) -> NoReturn:
        which = " and ".join(self._names[0][p] for p in along)
        raise ConfigError(
            f"{which} changes the {self._names[1]} in a way that no polynomial follows; vary another key, or "
            "calibrate within a smaller range"
        )


def _products(u: Tensor, degrees: dict[int, int]) -> Tensor:
    """Products [..., K] of powers of some parameters of u [..., n] in [0, 1], from the middle."""
    products = torch.ones_like(u[..., :1])
    for p, degree in degrees.items():
        powers = (2.0 * u[..., p, None] - 1.0) ** torch.arange(degree + 1, device=u.device)
        products = (products[..., :, None] * powers[..., None, :]).flatten(-2)
    return products
