"""What a run begins with and what forces it, as polynomials of the problem parameters.

A parameter may change the initial velocity, gravity or the motion of a solid. It does so through the
scene's configuration, which knows no gradient. A few scenes at chosen values tell the polynomial, and others
that it holds.
"""

import itertools
from collections.abc import Callable, Sequence
from typing import NoReturn

import numpy as np
import torch
from torch import Tensor

from nsf.errors import ConfigError

#: Degrees that are tried in turn: a velocity is linear in its speed, a direction takes more of its angle.
_DEGREES = (1, 2, 4, 8, 12)
_SAME = 1e-9  # of the largest value, by how much a polynomial may be off
_COMPARED = (0.137, 0.529, 0.871)  # where it is compared, in units of the ranges


class Polynomial:
    """An array as a polynomial of the problem parameters, in Chebyshev's basis.

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
        self._low, self._high = torch.as_tensor(np.asarray(ranges, float)).unbind(1)
        self._of, self._names, self._middle = of, names, np.mean(ranges, axis=1)
        self._shape = np.shape(of(self._middle))
        self._base = self._values([{}])[0]
        one = {p: self._values([{p: _COMPARED[0]}])[0] for p in range(len(ranges))}
        along = [p for p in one if not torch.equal(one[p], self._base)]
        self.varies = bool(along)
        compared = [dict.fromkeys(along, u) for u in _COMPARED] if along else []
        truth = self._values(compared) if along else self._base[None]
        self._slack = (
            _SAME * float(truth.abs().max().maximum(self._base.abs().max())) if truth.numel() else 0.0
        )
        degrees = {p: self._degree(p) for p in along}
        self._terms = [self._term(group, degrees) for group in self._groups(along, one)]
        if along and (self._at(compared) - truth).abs().max() > self._slack:
            self._refuse(along)

    def to(self, device: torch.device) -> "Polynomial":
        """Itself, with what it holds on a device."""
        for name in ("_low", "_high", "_base"):
            setattr(self, name, getattr(self, name).to(device))
        self._terms = [(degrees, coefficients.to(device)) for degrees, coefficients in self._terms]
        return self

    def __call__(self, parameters: Tensor) -> Tensor:
        """The array [..., *shape] at parameters [..., n]; [*shape] where none changes it."""
        if not self.varies:
            return self._base.view(self._shape)
        return self._sum((parameters - self._low) / (self._high - self._low)).unflatten(-1, self._shape)

    def _sum(self, u: Tensor) -> Tensor:
        """[..., size] at parameters u [..., n] in units of their ranges."""
        found = self._base
        for degrees, coefficients in self._terms:
            found = found + _rows(u, degrees) @ coefficients
        return found

    def _at(self, places: Sequence[dict[int, float]]) -> Tensor:
        return self._sum(self._units(places))

    def _units(self, places: Sequence[dict[int, float]]) -> Tensor:
        """u [places, n]: the middle of the ranges, but for some parameters."""
        u = torch.full((len(places), len(self._low)), 0.5, dtype=torch.float64)
        for row, place in zip(u, places, strict=True):
            for p, value in place.items():
                row[p] = value
        return u

    def _values(self, places: Sequence[dict[int, float]]) -> Tensor:
        """[places, size] of the array itself."""
        found = []
        for place in places:
            mu = self._middle.copy()
            for p, u in place.items():
                mu[p] = float(self._low[p]) + u * float(self._high[p] - self._low[p])
            found.append(np.ravel(np.asarray(self._of(mu), float)))
        return torch.as_tensor(np.stack(found))

    def _degree(self, p: int) -> int:
        """The least degree that follows a parameter by itself."""
        compared = [{p: u} for u in _COMPARED]
        truth = self._values(compared) - self._base
        for degree in _DEGREES:
            degrees, coefficients = self._term([p], {p: degree})
            if (
                float((_rows(self._units(compared), degrees) @ coefficients - truth).abs().max())
                <= self._slack
            ):
                return degree
        self._refuse([p])

    def _term(self, group: Sequence[int], degrees: dict[int, int]) -> tuple[dict[int, int], Tensor]:
        """Degrees of some parameters, and coefficients [products, size] of what they change together."""
        own = {p: degrees[p] for p in group}
        nodes = [0.5 - 0.5 * np.cos(np.pi * (np.arange(d + 1) + 0.5) / (d + 1)) for d in own.values()]
        places = [dict(zip(own, us, strict=True)) for us in itertools.product(*nodes)]
        change = self._values(places) - self._base
        return own, torch.linalg.solve(_rows(self._units(places), own), change)

    def _groups(self, along: Sequence[int], one: dict[int, Tensor]) -> list[list[int]]:
        """Parameters that act together: what two change at once is not what each changes by itself."""
        groups = [[p] for p in along]
        for p, other in itertools.combinations(along, 2):
            both = self._values([{p: _COMPARED[0], other: _COMPARED[0]}])[0]
            if float((both - one[p] - one[other] + self._base).abs().max()) > self._slack:
                mine, theirs = (next(g for g in groups if k in g) for k in (p, other))
                if mine is not theirs:
                    mine += theirs
                    groups.remove(theirs)
        return groups

    def _refuse(self, along: Sequence[int]) -> NoReturn:
        which = " and ".join(self._names[0][p] for p in along)
        raise ConfigError(
            f"{which} changes the {self._names[1]} in a way that no polynomial follows; vary another key, or "
            "calibrate within a smaller range"
        )


def _rows(u: Tensor, degrees: dict[int, int]) -> Tensor:
    """Products [..., K] of Chebyshev polynomials of some parameters of u [..., n] in [0, 1]."""
    rows = torch.ones_like(u[..., :1])
    for p, degree in degrees.items():
        x = 2.0 * u[..., p] - 1.0
        own = [torch.ones_like(x), x]
        for _ in range(degree - 1):
            own.append(2.0 * x * own[-1] - own[-2])
        rows = (rows[..., :, None] * torch.stack(own, -1)[..., None, :]).flatten(-2)
    return rows
