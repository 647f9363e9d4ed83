"""The GPU's driver, captures of its launches, and its arithmetic; torch is imported on first use."""

import ctypes
import gc
import sys
from collections.abc import Iterator
from contextlib import contextmanager
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


@contextmanager
def without_collection() -> Iterator[None]:
    """Leave garbage alone while launches are captured: arrays of a GPU cannot be freed in a capture."""
    collects = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if collects:
            gc.enable()


@contextmanager
def tf32() -> Iterator[None]:
    """Multiply matrices of fp32 on a GPU's tensor cores, with 10 bits after the leading one."""
    import torch

    matmul = torch.backends.cuda.matmul
    before = matmul.fp32_precision
    matmul.fp32_precision = "tf32"
    try:
        yield
    finally:
        matmul.fp32_precision = before
