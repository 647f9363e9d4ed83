"""How a recurrence is fitted, checked without torch."""

import math
from dataclasses import dataclass

from nsf.errors import ConfigError


@dataclass(frozen=True)
class Fitting:
    """How a recurrence is fitted.

    Attributes:
        width: of both hidden layers of each network.
        members: fitted side by side, whose runs are averaged.
        descents: steps of the descent.
        window: strides of the longest windows; None: half a run.
        ends: whether the last states of runs, which few windows reach, count as much as all others.
        batch: windows of each, a member.
        noise: on x̂ and ŝ at the start of a window [deviations].

    Raises:
        ConfigError: a value outside its range.
    """

    width: int = 96
    members: int = 1
    descents: int = 2000
    batch: int = 128
    noise: float = 0.01
    window: int | None = None
    ends: bool = False

    def __post_init__(self):
        for name in ("width", "members", "descents", "batch", "window"):
            if getattr(self, name) is not None and getattr(self, name) < 1:
                raise ConfigError(f"{name}={getattr(self, name)} must be at least 1")
        if not (math.isfinite(self.noise) and self.noise >= 0):
            raise ConfigError(f"noise={self.noise} must be finite and at least 0")


def check_stride(stride: int, steps: int) -> None:
    """Raises ConfigError where the stride does not divide the steps of a run."""
    if steps % stride:
        near = [k for k in range(1, 2 * stride) if steps % k == 0]
        raise ConfigError(
            f"model.stride={stride} does not divide the {steps} steps of a run; set model.stride to one of "
            f"{', '.join(map(str, near))}"
        )
