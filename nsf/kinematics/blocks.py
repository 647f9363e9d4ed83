"""How many frames are decoded together: as many as memory has room for."""

import torch

_HOST_BYTES = 2**25  # of a block on the CPU: about its last cache
_SHARE = 0.25  # of the free memory of a GPU
#: Modes of a tile of the product on the CPU [values]: about the second level of its cache.
TILE = 2**18


def frames_at_once(values: int, dtype: torch.dtype, device: torch.device | str) -> int:
    """Frames of so many values each that fit into a block on a device; at least one."""
    device, room = torch.device(device), _HOST_BYTES
    if device.type == "cuda":
        free, _ = torch.cuda.mem_get_info(device)
        spare = torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)
        room = int(_SHARE * (free + spare))
    return max(1, room // max(1, values * dtype.itemsize))
