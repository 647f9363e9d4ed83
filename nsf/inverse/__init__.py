"""Inverse problems by a taught recurrence: calibration, uncertainty and design.

A run by operators takes a fraction of a millisecond and is differentiable, so that thousands can be asked
for. Names are imported on first use, so that a command's help does not wait for torch.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from nsf.inverse.model import Forcing, Model

__all__ = ["Forcing", "Model"]

_HOMES = {"Forcing": "model", "Model": "model"}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)
