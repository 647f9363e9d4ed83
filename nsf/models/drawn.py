"""Models that learn from full-order runs of drawn cases, which are encoded as they are made."""

from dataclasses import dataclass
from typing import ClassVar

from typing_extensions import override

from nsf.errors import ConfigError
from nsf.models.base import Model
from nsf.recurrence.fitting import check_stride
from nsf.scalars import number

#: Drawn full-order runs where programs force a scene or do not, and the longest stride.
RUNS, STRIDE = {True: 256, False: 32}, 5


@dataclass(frozen=True)
class Drawn(Model):
    """Learns from full-order runs of drawn cases beside those of training, in strides of their steps.

    Attributes:
        runs: of drawn cases, which are encoded as they are made and not stored; None: `RUNS`.
        stride: steps of the full-order run that one of the model covers; None: the most, up to `STRIDE`, that
            divide the steps of a run.
        gravity: of its magnitude, by how much gravity of drawn runs is varied where no program does, so that
            it may be changed in deployment [-].
    """

    runs: int | None = None
    stride: int | None = None
    gravity: float = 0.1
    learns: ClassVar[bool] = True

    def __post_init__(self):
        for name, least in (("runs", 0), ("stride", 1)):
            if getattr(self, name) is not None:
                number(f"model.{name}", getattr(self, name), least=least, whole=True)
        number("model.gravity", self.gravity, least=0)

    def stride_of(self, steps: int) -> int:
        """Stride in runs of so many steps."""
        return self.stride or next(k for k in range(STRIDE, 0, -1) if steps % k == 0)

    def runs_of(self, forced: bool) -> int:
        """Drawn runs of a scene that programs force, or do not."""
        return self.runs if self.runs is not None else RUNS[forced]

    def stress_of(self, forced: bool) -> int:
        """Coordinates of τ in its state, likewise."""
        return 0

    @override
    def refuse(self, pipeline) -> None:
        c, split = pipeline.config, pipeline.split
        check_stride(self.stride_of(pipeline.scene.steps), pipeline.scene.steps)
        if c.deploy.dt_multiplier != 1:
            raise ConfigError(
                f"model={self.name} takes strides of the scene's Δt, and deploy.dt_multiplier is "
                f"{c.deploy.dt_multiplier:g}; set it to 1, and model.stride"
            )
        if pipeline.scene.forcing and not split.validation:
            raise ConfigError(
                f"model={self.name} chooses its weights by validation programs, and scene.design.validation "
                f"is {len(split.validation)}; set it to 4"
            )
        super().refuse(pipeline)
