"""What a run begins with and what forces it, as polynomials of the problem parameters.

A parameter may change the initial velocity, gravity or the motion of a solid. It does so through the
scene's configuration, which knows no gradient. A few scenes at chosen values tell the polynomial, and others
that it holds.
"""

import itertools
from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor

from nsf.errors import ConfigError

#: Degrees that are tried in turn: a velocity is linear in its speed, a direction takes more of its angle.
_DEGREES = (1, 2, 4, 8, 12)
_SAME = 1e-9  # of the largest value, by how much a polynomial may be off
_COMPARED = np.array([0.137, 0.529, 0.871])  # where it is compared, in units of the ranges


class Polynomial:
    """An array as a polynomial of the problem parameters, in Chebyshev's basis.

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
        self._of, self._middle = of, np.mean(ranges, axis=1)
        base = np.asarray(of(self._middle), float)
        self._shape = base.shape
        self._along = [
            p for p in range(len(ranges)) if not np.array_equal(of(self._at({p: _COMPARED[0]})), base)
        ]
        self.varies, self._degree = bool(self._along), 0
        self._coefficients = torch.as_tensor(base.reshape(1, -1))
        if self._along:
            self._fit(np.abs(base).max(initial=0.0), names)

    def to(self, device: torch.device) -> "Polynomial":
        """Itself, with what it holds on a device."""
        for name in ("_low", "_high", "_coefficients"):
            setattr(self, name, getattr(self, name).to(device))
        return self

    def __call__(self, parameters: Tensor) -> Tensor:
        """The array [..., *shape] at parameters [..., n]; [*shape] where none changes it."""
        if not self.varies:
            return self._coefficients[0].view(self._shape)
        u = (parameters - self._low) / (self._high - self._low)
        return (self._rows(u) @ self._coefficients).unflatten(-1, self._shape)

    def _at(self, places: dict[int, float]) -> np.ndarray:
        """Parameters [n] in the middle of their ranges, but for some, which are in units of theirs."""
        found = self._middle.copy()
        for p, u in places.items():
            found[p] = float(self._low[p]) + u * float(self._high[p] - self._low[p])
        return found

    def _rows(self, u: Tensor) -> Tensor:
        """Products [..., K] of Chebyshev polynomials of the parameters that matter, u [..., n] in [0, 1]."""
        rows = torch.ones_like(u[..., :1])
        for p in self._along:
            x = 2.0 * u[..., p] - 1.0
            own = [torch.ones_like(x), x]
            for _ in range(self._degree - 1):
                own.append(2.0 * x * own[-1] - own[-2])
            rows = (rows[..., :, None] * torch.stack(own[: self._degree + 1], -1)[..., None, :]).flatten(-2)
        return rows

    def _fit(self, size: float, names: tuple[Sequence[str], str]) -> None:
        compared = [dict.fromkeys(self._along, u) for u in _COMPARED]
        truth = self._values(compared)
        size = max(size, float(truth.abs().max()))
        for self._degree in _DEGREES:
            nodes = 0.5 - 0.5 * np.cos(np.pi * (np.arange(self._degree + 1) + 0.5) / (self._degree + 1))
            places = [
                dict(zip(self._along, us, strict=True))
                for us in itertools.product(nodes, repeat=len(self._along))
            ]
            self._coefficients = torch.linalg.solve(self._matrix(places), self._values(places))
            if float((self._matrix(compared) @ self._coefficients - truth).abs().max()) <= _SAME * size:
                return
        which = " and ".join(names[0][p] for p in self._along)
        raise ConfigError(
            f"{which} changes the {names[1]} in a way that no polynomial follows; vary another key, or "
            "calibrate within a smaller range"
        )

    def _matrix(self, places: Sequence[dict[int, float]]) -> Tensor:
        u = torch.full((len(places), len(self._low)), 0.5, dtype=torch.float64)
        for row, place in zip(u, places, strict=True):
            for p, value in place.items():
                row[p] = value
        return self._rows(u)

    def _values(self, places: Sequence[dict[int, float]]) -> Tensor:
        return torch.as_tensor(np.stack([np.ravel(self._of(self._at(place))) for place in places]))
