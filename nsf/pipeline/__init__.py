"""The chain from scene to report, stage by stage."""

from nsf.pipeline.chain import STAGES, Pipeline

__all__ = ["STAGES", "Pipeline"]
