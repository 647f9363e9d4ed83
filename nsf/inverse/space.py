"""The parameters that are sought, and where."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from nsf.errors import ConfigError
from nsf.inverse.call import check_taught
from nsf.inverse.model import Model

#: Deviation of a value of which nothing is known but its range, in units of the range.
UNKNOWN = 12.0**-0.5


@dataclass(frozen=True)
class Space:
    """The parameters that are sought, in units of their ranges; those that are known.

    Attributes:
        model: whose they are.
        free: names; ranges: [n, 2] theirs; log: [n] whether they are taken evenly in their logarithm.
        fixed: values of the others, by name.
    """

    model: Model
    free: tuple[str, ...]
    ranges: np.ndarray
    log: np.ndarray
    fixed: Mapping[str, float]

    @classmethod
    def of(cls, model: Model, stated: Mapping[str, Sequence[float] | float] | None = None) -> "Space":
        """Ranges, or values that are known, by name; what was taught of the others.

        Raises:
            ConfigError: a name is unknown, nothing is left to seek, or a range goes beyond what was taught.
        """
        stated = dict(stated or {})
        if unknown := [name for name in stated if name not in model.names]:
            raise ConfigError(f"there is no parameter {unknown[0]!r}; there are {', '.join(model.names)}")
        taught = dict(zip(model.names, model.ranges.tolist(), strict=True))
        fixed = {name: float(value) for name, value in stated.items() if np.ndim(value) == 0}
        ranges = {
            name: list(map(float, stated.get(name, taught[name]))) for name in taught if name not in fixed
        }
        for name, (low, high) in [*ranges.items(), *((name, (v, v)) for name, v in fixed.items())]:
            check_taught(name, low, high, *taught[name])
        if empty := [name for name, (low, high) in ranges.items() if low == high]:
            raise ConfigError(f"{empty[0]} has an empty range; give {empty[0]}={ranges[empty[0]][0]:g}")
        if not ranges:
            raise ConfigError("every parameter is given; leave out one that is to be found")
        log = np.array([model.scene.parameters[name].log for name in ranges])
        return cls(model, tuple(ranges), np.array(list(ranges.values())), log, fixed)

    def parameters(self, u: Tensor) -> Tensor:
        """All parameters [..., n] of those sought, u [..., free] in units of their ranges."""
        sought = dict(zip(self.free, self.values(u).unbind(-1), strict=True))
        every = [
            sought.get(name, torch.full_like(u[..., 0], self.fixed.get(name, 0.0)))
            for name in self.model.names
        ]
        return torch.stack(every, -1)

    def values(self, u: Tensor) -> Tensor:
        """Values [..., free] of u."""
        low, high = torch.as_tensor(self.ranges).to(u).unbind(1)
        log = torch.as_tensor(self.log).to(u.device)
        even = low + u * (high - low)
        safe_low, safe_high = (torch.where(log, end, torch.ones_like(end)) for end in (low, high))
        return torch.where(log, safe_low * (safe_high / safe_low) ** u, even)

    def units(self, values: np.ndarray) -> np.ndarray:
        """u [..., free] of values."""
        low, high = self.ranges.T
        even = (np.asarray(values, float) - low) / (high - low)
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.where(self.log, np.log(values / low) / np.log(high / low), even)
