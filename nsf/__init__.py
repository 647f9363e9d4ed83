"""Neural stress fields: reduced-order elastoplasticity and fracture."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from nsf.kinematics.manifold import Manifold

__all__ = ["Manifold"]


def __getattr__(name: str):
    # On demand, so that `nsf --help` does not wait for torch.
    if name == "Manifold":
        from nsf.kinematics.manifold import Manifold

        return Manifold
    raise AttributeError(f"module 'nsf' has no attribute {name!r}")
