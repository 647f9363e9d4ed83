"""Models, by name: how runs of a scene are computed from cases (`model=` of the configuration).

Names are imported on first use: what a configuration asks for is checked without torch.
"""

from typing import TYPE_CHECKING

from nsf.extras import on_first_use
from nsf.models.base import Model, describe

if TYPE_CHECKING:
    from nsf.models.auto import Auto
    from nsf.models.full import FullOrder
    from nsf.models.inputs import Inputs
    from nsf.models.interpolate import Interpolate, TrainingRuns
    from nsf.models.latent import LatentModel
    from nsf.models.projected import Projected
    from nsf.models.recurrence import Recurrence

__all__ = [
    "Auto",
    "FullOrder",
    "Inputs",
    "Interpolate",
    "LatentModel",
    "Model",
    "Projected",
    "Recurrence",
    "TrainingRuns",
    "describe",
]

__getattr__ = on_first_use(__name__)
