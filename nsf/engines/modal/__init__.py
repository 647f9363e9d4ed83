"""The step for fields that are modes times coefficients: a few compiled kernels, without torch."""

from typing import TYPE_CHECKING

from nsf.extras import on_first_use

if TYPE_CHECKING:
    from nsf.engines.modal.engine import Modal

__all__ = ["Modal"]

# On demand, so that `mirrors` does not wait for torch.
__getattr__ = on_first_use(__name__)
