"""How a closure is fitted; checked without torch."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from nsf.engines.operators.teaching import times_of_lags
from nsf.errors import ConfigError

_MOST = {"width": 4096, "stride": 10_000, "descent": 10_000_000, "unroll": 10_000, "batch": 100_000}


@dataclass(frozen=True)
class Closing:
    """How a closure of the projected step is fitted to the full-order runs of training.

    Attributes:
        width: of both hidden layers.
        stride: steps from one linearisation of the projected step to the next.
        descent: steps of Adam; before them a sixth as many in windows of a quarter of the length.
        unroll: steps of a window.
        batch: windows of a step of Adam.
        rate: learning rate at the start; it falls to 0 along a cosine.
        noise: on the start of a window [deviations of x̂].
        single: weight of single steps beside the windows.
        memory: times [s] of lags that the closure sees, as operators may.

    Raises:
        ConfigError: a value outside its range.
    """

    width: int = 96
    stride: int = 8
    descent: int = 1000
    unroll: int = 32
    batch: int = 128
    rate: float = 1e-3
    noise: float = 0.03
    single: float = 0.01
    memory: Sequence[float] = ()

    def __post_init__(self):
        object.__setattr__(self, "memory", times_of_lags(self.memory))
        for name, most in _MOST.items():
            if not 1 <= getattr(self, name) <= most:
                raise ConfigError(f"{name}={getattr(self, name)} must be at least 1 and at most {most:,}")
        for name in ("rate", "noise", "single"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) >= 0):
                raise ConfigError(f"{name}={getattr(self, name)} must be finite and at least 0")
        if self.rate == 0:
            raise ConfigError("rate=0 fits nothing; give a positive one")

    @property
    def courses(self) -> tuple[tuple[int, int], ...]:
        """Steps of windows, and steps of Adam on them, in order."""
        return (max(1, self.unroll // 4), max(1, self.descent // 6)), (self.unroll, self.descent)

    @property
    def turns(self) -> int:
        """Steps of Adam in all."""
        return sum(steps for _, steps in self.courses)
