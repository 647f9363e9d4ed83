"""Engines: how the steps of reduced runs are computed; each says what it can run, and why not the rest.

Names are imported on first use: most commands step nothing.
"""

from typing import TYPE_CHECKING

from nsf.extras import on_first_use

if TYPE_CHECKING:
    from nsf.engines.base import Engine
    from nsf.engines.building import moves_particles, reduced, reduced_batch
    from nsf.engines.choice import ENGINES, NAMES, choose
    from nsf.engines.modal import Modal
    from nsf.engines.reference import Reference

__all__ = [
    "ENGINES",
    "NAMES",
    "Engine",
    "Modal",
    "Reference",
    "choose",
    "moves_particles",
    "reduced",
    "reduced_batch",
]

__getattr__ = on_first_use(__name__)
