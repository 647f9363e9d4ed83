"""What a GPU multiplies matrices with."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import torch


@contextlib.contextmanager
def tf32() -> Iterator[None]:
    """Multiply matrices of fp32 on a GPU's tensor cores, with 10 bits after the leading one."""
    matmul = torch.backends.cuda.matmul
    # From torch 2.9 on the two names must not be mixed.
    name, on = ("fp32_precision", "tf32") if hasattr(matmul, "fp32_precision") else ("allow_tf32", True)
    before = getattr(matmul, name)
    setattr(matmul, name, on)
    try:
        yield
    finally:
        setattr(matmul, name, before)
