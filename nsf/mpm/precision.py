"""Scalar, vector and matrix types of one floating-point precision."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from nsf.errors import ConfigError


@dataclass(frozen=True)
class Precision:
    """The Warp and NumPy types that every kernel of one precision is built from.

    Attributes:
        name: `fp32` or `fp64`.
        real: Warp scalar.
        vec3: Warp 3-vector.
        vec4: Warp 4-vector.
        mat33: Warp 3×3 matrix, row major.
        numpy: NumPy scalar type.
        native: name of the scalar in C++ and CUDA.
    """

    name: str
    real: Any
    vec3: Any
    vec4: Any
    mat33: Any
    numpy: Any
    native: str


FP32 = Precision("fp32", wp.float32, wp.vec3f, wp.vec4f, wp.mat33f, np.float32, "float")
FP64 = Precision("fp64", wp.float64, wp.vec3d, wp.vec4d, wp.mat33d, np.float64, "double")
_BY_NAME = {"fp32": FP32, "fp64": FP64}


def precision_of(name: str | Precision) -> Precision:
    """Look a precision up by name.

    Raises:
        ConfigError: `name` is neither `fp32` nor `fp64`.
    """
    if isinstance(name, Precision):
        return name
    if name not in _BY_NAME:
        raise ConfigError(f"precision={name!r} is unknown; choose one of {', '.join(_BY_NAME)}")
    return _BY_NAME[name]
