"""What the teacher answered, and by what a round of teaching is judged."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from nsf.engines.operators.teacher import Teacher

#: Of the strongest coordinate's movement, what a coordinate is taken to move at least.
_HARDLY = 1e-3


@dataclass(frozen=True)
class Yardstick:
    """Runs that decide which round is kept, none of them at a held-out value.

    Attributes:
        teacher: at their values.
        positions: xhat [N + 1, r] → [N + 1, s, 3] [m] positions of particles that are looked at.
        truth: [N + 1, R, s, 3] [m] where these are.
    """

    teacher: Teacher
    positions: Callable[[Tensor], Tensor]
    truth: Tensor

    def error(self, runs: Tensor) -> float:
        """Mean displacement error of runs [N + 1, R, r], a fraction; ∞ where one is not finite."""
        if not bool(torch.isfinite(runs).all()):
            return math.inf
        errors = []
        for run, truth in zip(runs.unbind(1), self.truth.unbind(1), strict=True):
            moved = (truth - truth[0]).square().sum()
            errors.append(((self.positions(run) - truth).square().sum() / moved).sqrt())
        return float(torch.stack(errors).mean())

    def moves(self, xhat: Tensor, scale: Tensor) -> Tensor:
        """[r] how far particles move with each coordinate, RMS [m] a unit of it; at x̂ [r], by ± scale [r]."""
        either = [self.positions(xhat + way * torch.diag(scale)) for way in (1.0, -1.0)]
        found = ((either[0] - either[1]).square().sum(-1).mean(1).sqrt() / (2.0 * scale)).double()
        return found.clamp_min(max(_HARDLY * float(found.max()), torch.finfo(found.dtype).tiny))


@dataclass
class Labels:
    """What the teacher answered.

    Attributes:
        xhat, change: [M, r] states; acceleration: [M, r] d' − d.
        parameters: [M, n]; gravity: [M, 3] [m/s²]; features: [M, f] of the colliders.
        lag: [M, lags] of the memory.
    """

    xhat: Tensor
    change: Tensor
    acceleration: Tensor
    parameters: Tensor
    gravity: Tensor
    features: Tensor
    lag: Tensor

    @classmethod
    def joined(cls, parts: Sequence["Labels"]) -> "Labels":
        """All labels of some, those left out that are not finite."""
        rows = [torch.cat([getattr(part, name) for part in parts]) for name in cls.__dataclass_fields__]
        good = torch.stack([torch.isfinite(values).all(1) for values in rows]).all(0)
        return cls(*(values[good] for values in rows))
