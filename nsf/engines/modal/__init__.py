"""The step for fields that are modes times coefficients: a few compiled kernels, without torch."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from nsf.engines.modal.engine import Modal

__all__ = ["Modal"]


def __getattr__(name: str) -> Any:
    # On demand, so that `mirrors` does not wait for torch.
    if name == "Modal":
        from nsf.engines.modal.engine import Modal

        return Modal
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
