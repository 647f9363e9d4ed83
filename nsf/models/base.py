"""The interface of a model: which runs it refuses, whether it learns, and its engine."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, ClassVar

#: Who goes on with a run that is not to be believed.
FALLBACKS = ("none", "projected", "full")


@dataclass(frozen=True)
class Model(ABC):
    """How runs of a scene are computed from cases.

    A model is one class, and a file of `conf/model` that names it; docs/howto/model.md has an example.

    Attributes:
        name: as `model=` takes it, and as tables call it.
        learns: whether the stage `teach` makes something of it, once, that all its runs use
            (`nsf.models.drawn.Drawn`).
        projects: whether its runs take projected steps, on which trust is calibrated.
    """

    name: str
    learns: ClassVar[bool] = False
    projects: ClassVar[bool] = False

    def refuse(self, pipeline) -> None:  # noqa: B027 — most models run whatever is configured
        """Refuse a configuration that the model cannot run.

        Args:
            pipeline: the chain of the configuration, a `nsf.pipeline.Pipeline`.

        Raises:
            ConfigError: names the key and the remedy.
        """

    @abstractmethod
    def engine(self, pipeline, manifold):
        """The engine that takes the steps of its runs, or its name; `auto` for projected steps.

        Args:
            pipeline: a `nsf.pipeline.Pipeline`.
            manifold: trained fields.

        Raises:
            MissingRunError: it was not taught.
        """

    @property
    def lesson(self) -> dict[str, Any]:
        """The values on which its teaching depends besides scene, manifold and sample; they name its run."""
        return asdict(self)


def describe(config: Mapping, chosen: str = "") -> dict[str, str]:
    """The names of a configuration's `model`, `stress`, `affine` and `field`, as tables show them.

    Args:
        config: with these keys, as of a run's `configuration.yaml`.
        chosen: the model that `model=auto` took.
    """
    field = str(config["field"]["_target_"]).rpartition(".")[2].removesuffix("Field").lower()
    return {
        "model": chosen or str(config["model"]["name"]),
        "stress": str(config["stress"]),
        "affine": str(config["affine"]),
        "field": field,
    }
