"""The projected step along full-order runs: what it lacks of them, and how it answers to being off."""

from dataclasses import dataclass

import torch
from torch import Tensor

from nsf.engines.operators.teacher import Teacher

#: Either way, by which x̂ and d are moved, in their deviations.
_OF_X, _OF_D = 0.1, 0.3
_MARGIN = 0.1  # of the range of training runs, by which what a closure is told may leave it


@dataclass
class Linearised:
    """P(x̂, d) − d of the projected step about runs, to first order.

    Attributes:
        runs: [N + 1, R, r] x̂ of the full-order runs; changes: [N, R, r] d = x̂_n − x̂_{n−1} of each step.
        defect: [N, R, r] d_{n+1} − P(x̂_n, d_n): what the step lacks.
        of_x, of_d: [M, R, r, r] ∂(P − d)/∂x̂ and ∂(P − d)/∂d at every `stride`-th step.
        stride: steps between these.
        lost: share of all of these numbers that were not finite, and are taken for 0.
    """

    runs: Tensor
    changes: Tensor
    defect: Tensor
    of_x: Tensor
    of_d: Tensor
    stride: int
    lost: float

    @classmethod
    def along(cls, teacher: Teacher, runs: Tensor, stride: int) -> "Linearised":
        """About runs [N + 1, R, r] in the teacher's cases, by its steps, from two on."""
        changes = torch.cat([teacher.first_change()[None], torch.diff(runs, dim=0)])
        N = teacher.total_steps

        def bend(n: int, xhat: Tensor, change: Tensor) -> Tensor:
            """P − d [R, r]; at t = 0 with the forcing of a step later."""
            return teacher.step_from(max(n, 1), xhat, change) - xhat - change

        def slope(n: int, sizes: Tensor, of_x: bool) -> Tensor:
            """[R, r, r] by central differences."""
            columns = []
            for j, size in enumerate(sizes.tolist()):
                move = torch.zeros_like(runs[n])
                move[:, j] = size
                x, d = (move, 0.0) if of_x else (0.0, move)
                more, less = (bend(n, runs[n] + way * x, changes[n] + way * d) for way in (1.0, -1.0))
                columns.append((more - less) / (2.0 * size))
            return torch.stack(columns, -1)

        defect = [changes[n + 1] - changes[n] - bend(n, runs[n], changes[n]) for n in range(N)]
        sizes = {True: _OF_X * _deviation(runs), False: _OF_D * _deviation(changes)}
        of_x, of_d = ([slope(n, own, of) for n in range(0, N, stride)] for of, own in sizes.items())
        found = [torch.stack(values) for values in (defect, of_x, of_d)]
        finite = torch.cat([torch.isfinite(values).flatten() for values in found])
        found = [values.nan_to_num(0.0, 0.0, 0.0) for values in found]
        return cls(runs, changes[:N], *found, stride, 1.0 - float(finite.double().mean()))


@dataclass(frozen=True)
class Known:
    """The box of x̂ and d of training runs, and a little more: a closure is told of nothing outside.

    Attributes:
        x, d: [2, r] least and largest.
    """

    x: Tensor
    d: Tensor

    @classmethod
    def of(cls, runs: Tensor) -> "Known":
        """Of runs [N + 1, R, r]."""
        return cls(*(_box(values.flatten(0, 1)) for values in (runs, torch.diff(runs, dim=0))))

    def within(self, xhat: Tensor, change: Tensor) -> tuple[Tensor, Tensor]:
        """The nearest x̂ and d [..., r] inside."""
        return torch.clamp(xhat, *self.x), torch.clamp(change, *self.d)

    def to(self, *like) -> "Known":
        """In another dtype, on another device."""
        return Known(self.x.to(*like), self.d.to(*like))


def _box(rows: Tensor) -> Tensor:
    low, high = rows.amin(0), rows.amax(0)
    return torch.stack([low - _MARGIN * (high - low), high + _MARGIN * (high - low)])


def _deviation(values: Tensor) -> Tensor:
    return values.flatten(0, -2).std(0)
