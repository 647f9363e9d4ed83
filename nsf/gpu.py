"""Whether this machine could use a GPU at all, found without a library that would."""

import ctypes
import sys
from functools import cache

_LIBRARIES = {
    "win32": ("nvcuda.dll",),
    "linux": ("libcuda.so.1", "libcuda.so", "/usr/lib/wsl/lib/libcuda.so.1"),
}


@cache
def has_driver() -> bool:
    """Whether NVIDIA's driver can be loaded; without it there is no GPU for Warp or torch."""
    for name in _LIBRARIES.get(sys.platform, ()):
        try:
            ctypes.CDLL(name)
        except OSError:
            continue
        return True
    return False
