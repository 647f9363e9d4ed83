"""Scalars of a body's shape that can be measured with a ruler: pure functions, differentiable, in metres."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # the names of quantities are there without torch
    from torch import Tensor

#: Share of the particles whose mean is an end of the body: one particle would be noise.
_END = 0.01


def _end(values: Tensor, largest: bool) -> Tensor:
    """Mean [...] of the hundredth of values [..., particle] at one end."""
    return values.topk(max(1, int(_END * values.shape[-1])), -1, largest=largest).values.mean(-1)


def height(x: Tensor, X: Tensor) -> Tensor:
    """Height of the body [m]: from the lowest to the highest hundredth of its particles along z.

    Args:
        x: [..., particle, 3] m.
        X: [particle, 3] m at rest.
    """
    return _end(x[..., 2], True) - _end(x[..., 2], False)


def run_out(x: Tensor, X: Tensor) -> Tensor:
    """How far the body reaches sideways from its axis at rest [m]: the outermost hundredth of its particles.

    Args:
        x, X: as for `height`.
    """
    return _end((x[..., :2] - X[:, :2].mean(0)).norm(dim=-1), True)


def opening(x: Tensor, X: Tensor) -> Tensor:
    """Width of the widest crack across the body's longest axis at rest [m].

    The largest gap between neighbouring particles along the axis; of a whole body about their spacing.

    Args:
        x, X: as for `height`.
    """
    axis = int((X.amax(0) - X.amin(0)).argmax())
    return x[..., axis].sort(-1).values.diff(dim=-1).amax(-1)


def springback(x: Tensor, X: Tensor) -> Tensor:
    """How much of its height a pressed body has got back [m]: the last height less the smallest one.

    Args:
        x: [..., frame, particle, 3] m, from rest on.
        X: as for `height`.
    """
    heights = height(x, X)
    return heights[..., -1] - heights.amin(-1)


@dataclass(frozen=True)
class Quantity:
    """A scalar of a shape.

    Attributes:
        of: (x, X) → [m].
        whole: whether it takes all frames up to its time, or that of its time alone.
    """

    of: Callable[[Tensor, Tensor], Tensor]
    whole: bool = False


def at_end(heights: Tensor, x: Tensor, X: Tensor) -> dict[str, float]:
    """Every quantity at the end of a run [m], by name.

    Args:
        heights: [frame] `height` of each frame [m].
        x: [particle, 3] m of the last frame; X: as for `height`.
    """
    values = {name: float(one.of(x, X)) for name, one in QUANTITIES.items() if not one.whole}
    return values | {"springback": float(heights[-1] - heights.min())}


#: By the name that files of observations use.
QUANTITIES = {
    "height": Quantity(height),
    "run_out": Quantity(run_out),
    "opening": Quantity(opening),
    "springback": Quantity(springback, whole=True),
}
