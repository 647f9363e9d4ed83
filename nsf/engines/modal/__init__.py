"""The step for fields that are modes times coefficients: a few compiled kernels, without torch."""

from nsf.engines.modal.engine import Modal

__all__ = ["Modal"]
