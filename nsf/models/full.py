"""The full-order solver as a model, to stand in a table beside the others."""

from dataclasses import dataclass
from typing import ClassVar

from typing_extensions import override

from nsf.errors import ConfigError
from nsf.models.base import Model


@dataclass(frozen=True)
class FullOrder(Model):
    """The full-order run itself, so that δ is 0."""

    projects: ClassVar[bool] = True  # under one's hands, in `nsf view`

    @override
    def refuse(self, pipeline) -> None:
        c = pipeline.config
        if c.fallback != "none":
            raise ConfigError(f"fallback={c.fallback} has no use with model=full; set fallback=none")
        if c.deploy.dt_multiplier != 1:
            raise ConfigError(
                f"model=full takes the scene's Δt, and deploy.dt_multiplier is {c.deploy.dt_multiplier:g}; "
                "set it to 1, or change scene.dt"
            )

    @override
    def engine(self, pipeline, manifold) -> str:
        return pipeline.projecting  # which decodes t = 0, and takes no step
