"""Forcing: gravity and the poses of solids over time, by programs or by hand."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, partial
from typing import TYPE_CHECKING

import numpy as np

from nsf.errors import ConfigError
from nsf.mpm.boundaries.colliders import Collider
from nsf.mpm.boundaries.motion import Motion
from nsf.mpm.precision import Precision
from nsf.vectors import at_times, numbers, vector

if TYPE_CHECKING:
    from nsf.mpm.boundaries.arrays import BoundaryArrays


@dataclass(frozen=True)
class Gravity:
    """Keyframes of gravity, linear between them, constant before the first and after the last.

    Attributes:
        times: [k] times of the keyframes [s], ascending.
        values: [k, 3] gravity [m/s²].

    Raises:
        ConfigError: no keyframe, times that do not ascend, another number of values, a value that is not
            finite.
    """

    times: Sequence[float]
    values: Sequence[Sequence[float]]

    def __post_init__(self):
        times = numbers("gravity.times", self.times, "s")
        if not len(times) or (np.diff(times) <= 0.0).any():
            raise ConfigError(f"gravity.times={self.times} s must be at least one and ascend")
        if len(self.values) != len(times):
            raise ConfigError(
                f"gravity.values has {len(self.values)} keyframes; give {len(times)}, one for each time"
            )
        for value in self.values:
            vector("gravity.values", value, "m/s²")

    @classmethod
    def constant(cls, value: Sequence[float]) -> "Gravity":
        """The same [3] [m/s²] at all times."""
        return cls((0.0,), (tuple(map(float, value)),))

    @property
    def varies(self) -> bool:
        """Whether it is not the same at all times."""
        return len(self.times) > 1

    def at(self, t) -> np.ndarray:
        """[n, 3] gravity [m/s²] at times t [n] [s]."""
        return at_times(t, self.times, self.values)


class Forcing:
    """Gravity, colliders and walls of simulations at the present step, on the device.

    A step reads gravity and the solids' poses from here, whatever brought them about: programs, which are
    keyframes on the device, or a hand between two steps. A captured step stays good. Solvers that take turns
    at the same simulations (the spans of a reduced run) share one object.

    Args:
        gravities: of each run, as [3] [m/s²] or its keyframes.
        boundaries: colliders and walls; for a batch equally many colliders of each run, in turn.
        precision, device: of the steps.

    Attributes:
        boundaries: as given.
        gravities: of each run, as they are now; those of a hand take the places of the programs.
        now: [runs] gravity of the moment [m/s²], for the kernels.
        version: how often a hand has changed anything.
    """

    def __init__(
        self,
        gravities: Sequence[Gravity | Sequence[float]],
        boundaries: "BoundaryArrays",
        precision: Precision,
        device,
    ):
        import warp as wp

        gravities = [g if isinstance(g, Gravity) else Gravity.constant(g) for g in gravities]
        self.boundaries, self._programs = boundaries, tuple(gravities)
        self.gravities, self.version = list(gravities), 0
        self._real = precision.numpy
        self.now = wp.array(self._first(), dtype=precision.vec3, device=device)
        self._varies = any(gravity.varies for gravity in gravities)
        if not self._varies:
            return
        self._steps = wp.zeros(len(gravities), dtype=wp.int32, device=device)
        # The first keyframe of each run is for a hand.
        ends = np.cumsum([1 + len(gravity.times) for gravity in gravities])
        self._keyframe_rows = begin, last = np.array([0, *ends[:-1]]) + 1, ends - 1
        times = np.concatenate([[0.0, *gravity.times] for gravity in gravities])
        self._keyframe_values = np.concatenate([[np.zeros(3), *gravity.values] for gravity in gravities])
        self._times = wp.array(times, dtype=wp.float64, device=device)
        self._values = wp.array(self._keyframe_values, dtype=wp.vec3d, device=device)
        self._from, self._last = (wp.array(rows, dtype=wp.int32, device=device) for rows in (begin, last))
        self._follow = partial(wp.launch, make_follow_gravity(precision), dim=len(self), device=device)

    def __len__(self) -> int:
        return len(self._programs)

    @property
    def steady(self) -> bool:
        """Whether it is the same at all times, so that it does no work on the whole of a closed path."""
        return not (self._varies or self.boundaries.changes or self.version)

    def start_from(self, steps: int) -> None:
        """Let the next step be the one that starts `steps` steps after t = 0."""
        self.boundaries.start_from(steps)
        if self._varies:
            self._steps.fill_(steps)

    def advance(self, dt: float) -> None:
        """Set gravity and the solids' poses for the next step of dt [s], where they change."""
        self.boundaries.advance(dt)
        if self._varies:
            inputs = [self._times, self._values, self._from, self._last, dt, self._steps, self.now]
            self._follow(inputs=inputs)

    def set_gravity(self, values: np.ndarray, runs: Sequence[int] | None = None) -> None:
        """Gravity [n, 3] [m/s²] of some runs, all by default, from the next step on, in place of programs."""
        runs = range(len(self)) if runs is None else runs
        for run, value in zip(runs, values, strict=True):
            self.gravities[run] = Gravity.constant(value)
        self._changed()

    def move(self, run: int, collider: int, motion: Motion) -> None:
        """Another motion of two keyframes for a solid of a run, in place of its own."""
        each = len(self.boundaries.colliders) // len(self)
        self.boundaries.move(run * each + collider, motion)
        self.version += 1

    def release(self) -> None:
        """Give everything back to the programs."""
        if not self.version:
            return
        self.gravities = list(self._programs)
        self.boundaries.release()
        self._changed()

    def _changed(self) -> None:
        """Tell the device which gravity each run has."""
        self.version += 1
        self.now.assign(self._first())
        if not self._varies:
            return
        by_hand = np.array([a is not b for a, b in zip(self.gravities, self._programs, strict=True)])
        begin, last = self._keyframe_rows
        for run in np.flatnonzero(by_hand):
            self._keyframe_values[begin[run] - 1] = self.gravities[run].values[0]
        self._values.assign(self._keyframe_values)
        self._from.assign(np.where(by_hand, begin - 1, begin).astype(np.int32))
        self._last.assign(np.where(by_hand, begin - 1, last).astype(np.int32))

    def colliders_of(self, run: int) -> tuple[Collider, ...]:
        """The solids of a run, as they are now."""
        each = len(self.boundaries.colliders) // len(self)
        return self.boundaries.colliders[run * each : (run + 1) * each]

    def gravity_at(self, t) -> np.ndarray:
        """[runs, n, 3] gravity [m/s²] at times t [n] [s], as programs and hand have it now."""
        return np.stack([gravity.at(t) for gravity in self.gravities])

    def _first(self) -> np.ndarray:
        return np.array([gravity.values[0] for gravity in self.gravities], self._real)

    @property
    def nbytes(self) -> int:
        """Bytes of the gravity on the device."""
        arrays = (self.now,) if not self._varies else (self.now, self._times, self._values, self._steps)
        return sum(array.capacity for array in arrays)


class Hand:
    """The forcing of one simulation, set between its steps; `restart` gives it back to the programs.

    Args:
        forcing: of the simulations.
        clock: gives the time [s].
        run: which of them; its colliders are the run's.
        names: of the run's colliders.
    """

    def __init__(self, forcing: Forcing, clock: Callable[[], float], run: int = 0, names: Sequence[str] = ()):
        self._forcing, self._clock, self._run, self._names = forcing, clock, run, tuple(names)

    @property
    def gravity(self) -> np.ndarray:
        """[3] [m/s²] of the next step; set it, and it holds from the next step on."""
        return self._forcing.gravities[self._run].at(self._clock())

    @gravity.setter
    def gravity(self, value: Sequence[float]) -> None:
        self._forcing.set_gravity([vector("forcing.gravity", value, "m/s²")], [self._run])

    def move(self, collider: str, velocity: Sequence[float] = (0.0, 0.0, 0.0), spin: float = 0.0) -> None:
        """Let a solid go on from where it is, from the next step on.

        Args:
            collider: its name.
            velocity: [3] [m/s].
            spin: about the axis of its own motion [°/s].

        Raises:
            ConfigError: there is no such solid, or it stands still by itself; a value is not finite.
        """
        if collider not in self._names:
            names = ", ".join(self._names) or "none"
            raise ConfigError(f"there is no collider {collider!r}; there are: {names}")
        index = self._names.index(collider)
        motion = self._forcing.colliders_of(self._run)[index].motion
        if motion is None:
            raise ConfigError(
                f"collider {collider!r} stands still in its scene; give it a motion there, or a program in "
                f"scene.forcing.colliders.{collider}"
            )
        velocity = np.array(vector("velocity", velocity, "m/s"))
        (spin,) = numbers("spin", [spin], "°/s", 1)
        self._forcing.move(self._run, index, motion.steered(self._clock(), velocity, float(spin)))

    def release(self) -> None:
        """Give everything back to the programs."""
        self._forcing.release()


@cache
def make_follow_gravity(precision: Precision):
    """Kernel that sets the gravity of each run for the step that starts at t^n, and counts the step."""
    import warp as wp

    from nsf.mpm.boundaries.arrays import keyframe_before

    vec3, f64, vec3d = precision.vec3, wp.float64, wp.vec3d

    @wp.kernel(enable_backward=False, module="unique")
    def follow_gravity(
        times: wp.array(dtype=f64),
        values: wp.array(dtype=vec3d),
        first: wp.array(dtype=wp.int32),
        last: wp.array(dtype=wp.int32),
        dt: f64,
        steps: wp.array(dtype=wp.int32),
        now: wp.array(dtype=vec3),
    ):
        run = wp.tid()
        n = steps[run]
        steps[run] = n + 1
        k, share = keyframe_before(times, first[run], last[run], f64(n) * dt)
        now[run] = vec3(wp.lerp(values[k], values[wp.min(k + 1, last[run])], share))

    return follow_gravity
