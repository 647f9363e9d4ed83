"""How many frames are decoded together, and how far tensor cores put them off."""

import torch
from torch import Tensor

#: [byte] of a block: on the CPU about its last cache, on a GPU so much that launching it costs nothing.
_HOST_BYTES, _DEVICE_BYTES = 2**25, 2**29
_ROWS = 3 * 500  # of modes at most, of which the error of tf32 is taken
_SLICES = 128  # of a product, which a GPU works on side by side
#: Modes of a tile of the product on the CPU [values]: about the second level of its cache.
TILE = 2**18


def frames_at_once(values: int, dtype: torch.dtype, device: torch.device | str) -> int:
    """Frames of so many values each that fit into a block on a device; at least one."""
    room = _DEVICE_BYTES if torch.device(device).type == "cuda" else _HOST_BYTES
    return max(1, room // max(1, values * dtype.itemsize))


def tf32_error(coefficients: Tensor, modes: Tensor) -> float:
    """Error of a product whose factors are rounded to tf32, over its size; at some evenly spread rows.

    Args:
        coefficients: [F, K] float32; modes: [n, K] float32.
    """
    some = modes[:: max(1, len(modes) // _ROWS)]
    exact = coefficients.double() @ some.double().T
    off = _as_tf32(coefficients).double() @ _as_tf32(some).double().T - exact
    return float(off.norm() / exact.norm().clamp_min(1e-300))


def _as_tf32(values: Tensor) -> Tensor:
    """float32 with the 10 bits of mantissa that tensor cores take, to the nearest."""
    return ((values.contiguous().view(torch.int32) + 0x1000) & ~0x1FFF).view(torch.float32)


def coordinates(values: Tensor, modes: Tensor) -> Tensor:
    """Products [F, k] of few rows [F, n] with modes [n, k], n ≫ F, k.

    In one product of that shape most of a GPU may be idle, so there it is summed over slices of n.
    """
    return in_slices(values, modes) if values.is_cuda else values @ modes


def in_slices(values: Tensor, modes: Tensor) -> Tensor:
    """`coordinates`, summed over slices of n."""
    width = len(modes) // _SLICES
    whole = _SLICES * width
    parts = values[:, :whole].unflatten(1, (_SLICES, width)).transpose(0, 1)
    return (parts @ modes[:whole].unflatten(0, (_SLICES, width))).sum(0) + values[:, whole:] @ modes[whole:]
