"""The paper's model: MPM steps of sample particles, projected onto the latent vector."""

from dataclasses import dataclass
from typing import ClassVar

from typing_extensions import override

from nsf.errors import ConfigError
from nsf.models.base import Model


@dataclass(frozen=True)
class Projected(Model):
    """Steps of section 5 of the paper, compiled where they can be and by the reference elsewhere."""

    projects: ClassVar[bool] = True

    @override
    def refuse(self, pipeline) -> None:
        if pipeline.config.fallback == "projected":
            raise ConfigError(
                "fallback=projected goes on for another model, and model=projected is that already; set "
                "fallback=full, or none"
            )

    @override
    def engine(self, pipeline, manifold) -> str:
        return pipeline.projecting
