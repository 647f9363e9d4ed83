"""What a page holds, as Python reads it."""

import json
import math
import struct

import numpy as np


def unpacked(data: bytes) -> tuple[dict, dict[str, np.ndarray]]:
    """Header and arrays of `nsf.live.page.packed`."""
    (length,) = struct.unpack_from("<I", data)
    header, at, arrays = json.loads(data[4 : 4 + length]), 4 + length, {}
    for name, own in header["arrays"].items():
        kind, count = np.dtype(f"<{own['type']}"), math.prod(own["shape"])
        arrays[name] = np.frombuffer(data, kind, count, at).reshape(own["shape"])
        at += -(-arrays[name].nbytes // 8) * 8
    assert at == len(data)
    return header, arrays
