"""The chain from scene to report, stage by stage."""

from typing import TYPE_CHECKING

from nsf.extras import on_first_use
from nsf.pipeline.names import STAGES

if TYPE_CHECKING:
    from nsf.pipeline.chain import Pipeline

__all__ = ["STAGES", "Pipeline"]

# On demand, so that names of runs do not wait for torch.
__getattr__ = on_first_use(__name__)
