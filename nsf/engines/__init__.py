"""Engines: how the steps of reduced runs are computed; each says what it can run, and why not the rest.

Names are imported on first use: most commands step nothing.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from nsf.engines.base import Engine
    from nsf.engines.building import reduced, reduced_batch
    from nsf.engines.choice import ENGINES, choose
    from nsf.engines.modal import Modal
    from nsf.engines.names import NAMES
    from nsf.engines.operators import Operators
    from nsf.engines.reference import Reference

__all__ = [
    "ENGINES",
    "NAMES",
    "Engine",
    "Modal",
    "Operators",
    "Reference",
    "choose",
    "reduced",
    "reduced_batch",
]

_HOMES = {
    "ENGINES": "choice",
    "NAMES": "names",
    "Engine": "base",
    "Modal": "modal",
    "Operators": "operators",
    "Reference": "reference",
    "choose": "choice",
    "reduced": "building",
    "reduced_batch": "building",
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)
