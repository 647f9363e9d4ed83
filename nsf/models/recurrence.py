"""A learned recurrence of the latent state (docs/method.md); microseconds a step."""

from dataclasses import dataclass
from typing import ClassVar

from typing_extensions import override

from nsf.errors import ConfigError
from nsf.models.base import Model
from nsf.recurrence.fitting import Fitting, check_stride
from nsf.scalars import number

#: Drawn full-order runs that teach it, and coordinates of stress, where programs force a scene or do not.
RUNS, STRESS = {True: 256, False: 32}, {True: 32, False: 0}
STRIDE = 5


@dataclass(frozen=True)
class Recurrence(Model):
    """Strides of the latent state, learned from full-order runs: those of training, and of drawn cases.

    Attributes:
        runs: full-order runs of drawn cases, which are encoded as they are made and not stored; None: `RUNS`.
        stress: coordinates ŝ of τ beside x̂; None: `STRESS`.
        stride: steps of the full-order run that a step of the recurrence covers; None: the most, up to
            `STRIDE`, that divide the steps of a run.
        gravity: of its magnitude, by how much gravity of drawn runs is varied where no program does, so that
            it may be changed in deployment [-].
        members, width, descents: as for `nsf.recurrence.Fitting`.
    """

    runs: int | None = None
    stress: int | None = None
    stride: int | None = None
    members: int = 4
    width: int = 96
    descents: int = 2000
    gravity: float = 0.1
    learns: ClassVar[bool] = True

    def __post_init__(self):
        for name, least in (("runs", 0), ("stress", 0), ("stride", 1)):
            if getattr(self, name) is not None:
                number(f"model.{name}", getattr(self, name), least=least, whole=True)
        number("model.gravity", self.gravity, least=0)
        self.fitting  # noqa: B018 — checks its values

    @property
    def fitting(self) -> Fitting:
        """How it is fitted."""
        return Fitting(self.width, self.members, self.descents)

    def stride_of(self, steps: int) -> int:
        """Stride in runs of so many steps."""
        return self.stride or next(k for k in range(STRIDE, 0, -1) if steps % k == 0)

    def runs_of(self, forced: bool) -> int:
        """Drawn runs of a scene that programs force, or do not."""
        return self.runs if self.runs is not None else RUNS[forced]

    def stress_of(self, forced: bool) -> int:
        """Coordinates of τ, likewise."""
        return self.stress if self.stress is not None else STRESS[forced]

    @override
    def refuse(self, pipeline) -> None:
        c, split, forced = pipeline.config, pipeline.split, bool(pipeline.scene.forcing)
        check_stride(self.stride_of(pipeline.scene.steps), pipeline.scene.steps)
        if c.deploy.dt_multiplier != 1:
            raise ConfigError(
                f"model=recurrence takes strides of the scene's Δt, and deploy.dt_multiplier is "
                f"{c.deploy.dt_multiplier:g}; set it to 1, and model.stride"
            )
        if forced and not split.validation:
            raise ConfigError(
                "model=recurrence chooses its weights by validation programs, and scene.design.validation is "
                f"{len(split.validation)}; set it to 4"
            )
        runs, stress = len(split.train) + self.runs_of(forced), self.stress_of(forced)
        if runs < stress:
            raise ConfigError(
                f"model.stress={stress} coordinates need as many runs, and there are {runs}; set "
                f"model.runs={stress - len(split.train)}, or model.stress={runs} or fewer"
            )

    @override
    def engine(self, pipeline, manifold):
        return pipeline.recurrence()
