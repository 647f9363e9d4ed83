"""Engines: how the steps of reduced runs are computed; each says what it can run, and why not the rest."""

from nsf.engines.base import Engine
from nsf.engines.choice import ENGINES, NAMES, choose
from nsf.engines.modal import Modal
from nsf.engines.operators import Operators
from nsf.engines.reduced import reduced, reduced_batch
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
