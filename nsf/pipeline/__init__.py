"""The chain from scene to report, stage by stage."""

from typing import TYPE_CHECKING

from nsf.extras import on_first_use

if TYPE_CHECKING:
    from nsf.pipeline.chain import STAGES, Pipeline

__all__ = ["STAGES", "Pipeline"]

# On demand, so that `nsf --help` waits for nothing.
__getattr__ = on_first_use(__name__)
