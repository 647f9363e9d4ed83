"""Scalar, vector and matrix types of one floating-point precision."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from nsf.scalars import one_of


@dataclass(frozen=True)
class Precision:
    """The Warp and NumPy types that every kernel of one precision is built from.

    Warp is imported at the first use of one of its types, so that values are checked without it.

    Attributes:
        name: `fp32` or `fp64`.
        numpy: NumPy scalar type.
        native: name of the scalar in C++ and CUDA.
        suffix: of Warp's names of vectors and matrices.
    """

    name: str
    numpy: Any
    native: str
    suffix: str

    @cached_property
    def real(self):
        """Warp scalar."""
        return getattr(_warp(), np.dtype(self.numpy).name)

    @cached_property
    def vec3(self):
        """Warp 3-vector."""
        return getattr(_warp(), f"vec3{self.suffix}")

    @cached_property
    def vec4(self):
        """Warp 4-vector."""
        return getattr(_warp(), f"vec4{self.suffix}")

    @cached_property
    def mat33(self):
        """Warp 3×3 matrix, row major."""
        return getattr(_warp(), f"mat33{self.suffix}")


def _warp():
    from nsf.mpm.device import wp  # which starts it

    return wp


FP32 = Precision("fp32", np.float32, "float", "f")
FP64 = Precision("fp64", np.float64, "double", "d")
_BY_NAME = {"fp32": FP32, "fp64": FP64}


def precision_of(name: str | Precision) -> Precision:
    """Look a precision up by name.

    Raises:
        ConfigError: `name` is neither `fp32` nor `fp64`.
    """
    if isinstance(name, Precision):
        return name
    return _BY_NAME[one_of("precision", name, _BY_NAME)]
