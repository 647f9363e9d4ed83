"""Neural stress fields: reduced-order elastoplasticity and fracture."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from nsf.inverse.model import Model
    from nsf.kinematics.manifold import Manifold

__all__ = ["Manifold", "Model"]


def __getattr__(name: str):
    # On demand, so that `nsf --help` does not wait for torch.
    if name == "Manifold":
        from nsf.kinematics.manifold import Manifold

        return Manifold
    if name == "Model":
        from nsf.inverse.model import Model

        return Model
    raise AttributeError(f"module 'nsf' has no attribute {name!r}")
