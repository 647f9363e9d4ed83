"""Neural stress fields: reduced-order elastoplasticity and fracture."""

from typing import TYPE_CHECKING

from nsf.extras import on_first_use

if TYPE_CHECKING:
    from nsf.inverse.model import Model
    from nsf.kinematics.manifold import Manifold

__all__ = ["Manifold", "Model"]

# On demand, so that `nsf --help` does not wait for torch.
__getattr__ = on_first_use(__name__)
