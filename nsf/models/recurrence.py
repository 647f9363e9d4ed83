"""A learned recurrence of the latent vector (docs/method.md); microseconds a step."""

from dataclasses import asdict, dataclass
from typing import Any, ClassVar

from typing_extensions import override

from nsf.engines.operators.teaching import Teaching
from nsf.errors import ConfigError
from nsf.models.base import Model
from nsf.vectors import number

#: Whose steps a recurrence learns: the projected model's, or those of the full-order runs of training.
TEACHERS = (PROJECTED, RUNS) = ("projected", "runs")


@dataclass(frozen=True)
class Recurrence(Model):
    """Steps of the latent vector alone, learned from projected steps or from full-order runs of training.

    Attributes:
        teacher: `projected` or `runs`.
        check: steps from one projected step to the next, which estimate the error.
        error_ratio: with teacher=runs: where the recurrence is more than this many times as far off at
            validation runs as the projected model, that takes all runs; None: never.
        teaching: how it is taught.
    """

    teaching: Teaching
    teacher: str = PROJECTED
    check: int = 20
    error_ratio: float | None = 1.25
    learns: ClassVar[bool] = True
    projects: ClassVar[bool] = True

    def __post_init__(self):
        if self.teacher not in TEACHERS:
            raise ConfigError(f"teacher={self.teacher} is unknown; choose one of {', '.join(TEACHERS)}")
        number("check", self.check, least=1, whole=True)
        if self.error_ratio is not None and not number("error_ratio", self.error_ratio) > 0:
            raise ConfigError(
                f"error_ratio={self.error_ratio} must be positive, or null to leave it all runs"
            )

    @property
    def of_runs(self) -> bool:
        """Whether it learns from full-order runs of training."""
        return self.teacher == RUNS

    @override
    def refuse(self, names) -> None:
        c, teaching = names.config, self.teaching
        if teaching.memory and not self.of_runs:
            raise ConfigError(
                f"model.teaching.memory={list(teaching.memory)} is learned from runs "
                f"alone; set model.teacher={RUNS}, or model.teaching.memory=[]"
            )
        if teaching.runs and not self.of_runs:
            raise ConfigError(
                f"model.teaching.runs={teaching.runs} stand beside full-order runs; set "
                f"model.teacher={RUNS}, or model.teaching.runs=0"
            )
        if self.of_runs and c.deploy.dt_multiplier != 1:
            raise ConfigError(
                f"model.teacher={RUNS} teaches steps of the scene's Δt, and deploy.dt_multiplier is "
                f"{c.deploy.dt_multiplier:g}; set it to 1, or model.teacher={PROJECTED}"
            )
        if c.stress == "particles" and not self.of_runs:
            raise ConfigError(
                f"model.teacher={self.teacher} is asked for single steps, which depend on what particles "
                f"went through with stress=particles; set model.teacher={RUNS}, or stress=field affine=field"
            )

    @override
    def engine(self, pipeline, manifold):
        return pipeline.operators()

    @property
    @override
    def lesson(self) -> dict[str, Any]:
        return {"name": self.name, "teacher": self.teacher, "teaching": asdict(self.teaching)}
