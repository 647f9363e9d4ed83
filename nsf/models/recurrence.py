"""A learned recurrence of the latent state (docs/method.md); microseconds a step."""

from dataclasses import dataclass

from typing_extensions import override

from nsf.errors import ConfigError
from nsf.models.drawn import Drawn
from nsf.recurrence.fitting import Fitting
from nsf.scalars import number

#: Coordinates of stress where programs force a scene, or do not.
STRESS = {True: 32, False: 0}
#: Windows in a step of the descent, likewise.
BATCH = {True: 128, False: 32}


@dataclass(frozen=True)
class Recurrence(Drawn):
    """Strides of the latent state, learned from full-order runs: those of training, and of drawn cases.

    Attributes:
        stress: coordinates ŝ of τ beside x̂; None: `STRESS`.
        batch: windows in a step of the descent, a member; None: `BATCH`.
        members, width, descents, window: as for `nsf.recurrence.Fitting`.
    """

    stress: int | None = None
    members: int = 4
    width: int = 96
    descents: int = 2000
    batch: int | None = None
    window: int | None = None

    def __post_init__(self):
        super().__post_init__()
        if self.stress is not None:
            number("model.stress", self.stress, least=0, whole=True)
        self.fitting_of(True)  # checks its values

    def fitting_of(self, forced: bool) -> Fitting:
        """How it is fitted where programs force a scene, or do not."""
        batch = self.batch if self.batch is not None else BATCH[forced]
        return Fitting(self.width, self.members, self.descents, batch, window=self.window, ends=not forced)

    @override
    def stress_of(self, forced: bool) -> int:
        return self.stress if self.stress is not None else STRESS[forced]

    @override
    def refuse(self, pipeline) -> None:
        super().refuse(pipeline)
        split, forced = pipeline.split, bool(pipeline.scene.forcing)
        runs, stress = len(split.train) + self.runs_of(forced), self.stress_of(forced)
        if runs < stress:
            raise ConfigError(
                f"model.stress={stress} coordinates need as many runs, and there are {runs}; set "
                f"model.runs={stress - len(split.train)}, or model.stress={runs} or fewer"
            )

    @override
    def engine(self, pipeline, manifold):
        return pipeline.recurrence()
