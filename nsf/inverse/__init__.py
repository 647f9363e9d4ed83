"""Inverse problems by a taught recurrence: calibration, uncertainty and design.

A run by recurrence takes a fraction of a millisecond and is differentiable, so that thousands can be asked
for. Names are imported on first use, so that a command's help does not wait for torch.
"""

from typing import TYPE_CHECKING

from nsf.extras import on_first_use

if TYPE_CHECKING:
    from nsf.inverse.model import Forcing, Model

__all__ = ["Forcing", "Model"]

__getattr__ = on_first_use(__name__)
