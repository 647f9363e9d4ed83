"""Neural stress fields: reduced-order elastoplasticity and fracture."""

from typing import TYPE_CHECKING

from nsf.extras import on_first_use

if TYPE_CHECKING:
    from nsf.config.scenes import load_scene
    from nsf.engines.building import reduced, reduced_batch
    from nsf.inverse.model import Model
    from nsf.kinematics.manifold import Manifold
    from nsf.pipeline.finding import find

__all__ = ["Manifold", "Model", "find", "load_scene", "reduced", "reduced_batch"]

# On demand, so that `nsf --help` does not wait for torch.
__getattr__ = on_first_use(__name__)
