"""The chain from scene to report, stage by stage."""

from typing import TYPE_CHECKING, Any

from nsf.pipeline.names import STAGES

if TYPE_CHECKING:
    from nsf.pipeline.chain import Pipeline

__all__ = ["STAGES", "Pipeline"]


def __getattr__(name: str) -> Any:
    # On demand, so that names of runs do not wait for torch.
    if name == "Pipeline":
        from nsf.pipeline.chain import Pipeline

        return Pipeline
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
