"""Standardising of fields, component by component."""

from collections.abc import Iterable

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from nsf.data.snapshots import Snapshots
from nsf.errors import ShapeError

# Relative to a component's mean: less spread than this is float32 round-off of a constant.
_CONSTANT = 1e-6


class Standardizer(nn.Module):
    """Maps values to zero mean and unit standard deviation, and back.

    A component that does not vary (out-of-plane stress, say) is only centred:
    its `std` is 1. Mean and std are buffers, so they travel in `state_dict`.

    Args:
        mean: [c] in the unit of the values.
        std: [c] likewise, positive.

    Raises:
        ShapeError: `mean` and `std` differ in shape, or a value is not usable.
    """

    mean: Tensor
    std: Tensor

    def __init__(self, mean: Tensor, std: Tensor) -> None:
        super().__init__()
        if mean.shape != std.shape or mean.dim() != 1:
            raise ShapeError(f"mean has shape {list(mean.shape)} and std {list(std.shape)}; give [c] and [c]")
        if not (torch.isfinite(mean).all() and torch.isfinite(std).all() and (std > 0).all()):
            raise ShapeError(f"mean={mean.tolist()}, std={std.tolist()}; give finite values and positive std")
        self.register_buffer("mean", mean.clone())
        self.register_buffer("std", std.clone())

    @classmethod
    def fit(cls, blocks: Iterable[Float[Tensor, "*points component"]]) -> "Standardizer":
        """Mean and population standard deviation of values that come block by block.

        Sums are float64, shifted by the first value and so free of
        cancellation; the buffers are float32 on the blocks' device.

        Raises:
            ShapeError: there is no value.
        """
        count, total = 0, None
        for block in blocks:
            points = block.reshape(block.shape[:-1].numel(), block.shape[-1]).to(torch.float64)
            if not len(points):
                continue
            if total is None:
                shift = points[0].clone()
                total, squares = torch.zeros_like(shift), torch.zeros_like(shift)
            points = points - shift
            count += len(points)
            total += points.sum(0)
            squares += points.square().sum(0)
        if total is None:
            raise ShapeError("no value to standardise by; give at least one snapshot")
        offset = total / count
        mean = shift + offset
        std = (squares / count - offset.square()).clamp(min=0).sqrt()
        std = torch.where(std > _CONSTANT * mean.abs(), std, torch.ones_like(std))
        return cls(mean.float(), std.float())

    @classmethod
    def of(
        cls, snapshots: Snapshots, field: str, origin: Float[Tensor, "particle component"] | None = None
    ) -> "Standardizer":
        """Of every frame and particle of a field less an origin, read a slab of particles at a time."""
        return cls.fit(
            values - (0 if origin is None else origin[particles].float())
            for particles, values in snapshots.slabs(field)
        )

    def forward(self, values: Float[Tensor, "*points component"]) -> Float[Tensor, "*points component"]:
        """(values - mean) / std, dimensionless."""
        return (values - self.mean) / self.std


def deviation(rows: Float[np.ndarray, "row component"]) -> Float[np.ndarray, " component"]:
    """Standard deviation over rows, in their unit, to divide by: 1 for a component that never varies."""
    std = rows.std(0)
    return np.where(std > 0, std, 1.0)
