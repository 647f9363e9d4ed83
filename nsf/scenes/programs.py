"""Programs of the forcing: how gravity and the solids of a scene move in a run, drawn anew for each.

A program is drawn from its number, so that a run can be made again. It ends in keyframes; the dynamics see
their value of the moment alone, so a program may be of any length, and a hand may take its place.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from zlib import crc32

import numpy as np

from nsf.errors import ConfigError, first_line
from nsf.mpm import Gravity, Motion
from nsf.scalars import number
from nsf.scenes.tilts import across, normalised, tilted
from nsf.vectors import direction, numbers

#: Keyframes between two knots of a program.
_KEYFRAMES = 8
#: Keyframes of a curve; curves of which its reach is the most, and how much further it is taken to go.
_OF_CURVE, _TRIED, _SPARE = 101, 64, 1.05
#: Draws numbers, as `numpy.random.Generator.uniform(low, high)` does.
Draw = Callable[..., float]


class GravityProgram(ABC):
    """Changes gravity in the course of a run."""

    @abstractmethod
    def of(self, gravity: Gravity, duration: float, generator: np.random.Generator) -> Gravity:
        """The gravity that a run has.

        Args:
            gravity: of the scene, or as an earlier program left it.
            duration: of a run [s].
            generator: draws the program.
        """

    @abstractmethod
    def reach(self, gravity: np.ndarray, duration: float) -> float:
        """How far from a gravity [3] [m/s²] it may take it at most [m/s²], in a run of that duration [s]."""


@dataclass(frozen=True)
class GravityCurve(GravityProgram):
    """A program that is a formula of the time: keyframes, and how far they reach, are sampled from it."""

    @abstractmethod
    def values(self, t: np.ndarray, gravity: np.ndarray, draw: Draw) -> np.ndarray:
        """The gravity that a run has.

        Args:
            t: [n] times [s], from 0 to the end of the run.
            gravity: [n, 3] of the scene at these times [m/s²], or as an earlier program left it.
            draw: `draw(low, high)` is a number between both that differs from run to run.

        Returns:
            [n, 3] along x, y and z [m/s²].
        """

    def of(self, gravity: Gravity, duration: float, generator: np.random.Generator) -> Gravity:
        """See `GravityProgram.of`.

        Raises:
            ConfigError: `values` fails, or gives another shape or no numbers.
        """
        return self._drawn(gravity, duration, generator.uniform)

    def reach(self, gravity: np.ndarray, duration: float) -> float:
        """See `GravityProgram.reach`: the most of drawn curves, also at ends of ranges, and a bit."""
        base, generator, far = Gravity.constant(gravity), np.random.default_rng(0), 0.0

        def end(low=0.0, high=1.0, size=None):
            return np.where(generator.random(size) < 0.5, low, high)[()]

        def either(low=0.0, high=1.0, size=None):
            drawn = generator.uniform(low, high, size)
            return np.where(generator.random(size) < 0.5, end(low, high, size), drawn)[()]

        for draw in (generator.uniform, end, either):
            for _ in range(_TRIED):
                values = np.asarray(self._drawn(base, duration, draw).values)
                far = max(far, float(np.linalg.norm(values - gravity, axis=1).max()))
        return _SPARE * far

    def _drawn(self, gravity: Gravity, duration: float, draw: Draw) -> Gravity:
        t = np.linspace(0.0, duration, _OF_CURVE)
        name = f"{type(self).__name__}.values"
        try:
            values = self.values(t, np.array(gravity.at(t)), draw)
        except Exception as error:
            text = f"{name} raises {type(error).__name__}: {first_line(error)}"
            raise ConfigError(f"{text}; give gravity at each time") from error
        if np.shape(values) != (len(t), 3):
            raise ConfigError(
                f"{name} gives an array of shape {list(np.shape(values))}; return gravity at each of "
                f"{len(t)} times along x, y and z, as np.stack([x, y, z], axis=1)"
            )
        return Gravity(t.tolist(), np.asarray(values, float).tolist())


class MotionProgram(ABC):
    """Moves a solid in the course of a run."""

    @abstractmethod
    def motion(self, duration: float, generator: np.random.Generator) -> Motion:
        """The motion that a run has.

        Args:
            duration: of a run [s].
            generator: draws the program.
        """

    @abstractmethod
    def top_speed(self, duration: float) -> float:
        """Bound on the speed [m/s] of any motion that may be drawn."""


@dataclass(frozen=True)
class Keyframes(GravityProgram):
    """Gravity that is listed: linear between keyframes, the same in each run.

    Attributes:
        times: [k] [s], ascending; values: [k, 3] [m/s²], which take the place of the scene's gravity.
        angle: the largest angle [°] from the scene's gravity that the list may reach.

    Raises:
        ConfigError: see `nsf.mpm.Gravity`; at the first run, a value that is further off than `angle`.
    """

    times: Sequence[float]
    values: Sequence[Sequence[float]]
    angle: float = 180.0

    def __post_init__(self):
        Gravity(self.times, self.values)
        _check_angle("angle", self.angle)

    def of(self, gravity: Gravity, duration: float, generator: np.random.Generator) -> Gravity:
        """See `GravityProgram.of`."""
        down = normalised(gravity.at(0.0))
        for t, value in zip(self.times, self.values, strict=True):
            off = np.degrees(np.arccos(np.clip(down @ normalised(np.array(value)), -1.0, 1.0)))
            if np.any(value) and np.any(down) and off > self.angle + 1e-9:
                raise ConfigError(
                    f"the program's gravity at t = {t:g} s is {off:.3g}° off, beyond angle={self.angle:g}°; "
                    "change the values, or declare a larger angle"
                )
        return Gravity(self.times, self.values)

    def reach(self, gravity: np.ndarray, duration: float) -> float:
        """See `GravityProgram.reach`."""
        return float(np.linalg.norm(self.values, axis=1).max() + np.linalg.norm(gravity))


@dataclass(frozen=True)
class RandomTilt(GravityProgram):
    """Gravity whose direction wanders, or the ground under it, from upright on.

    Attributes:
        angle: the largest tilt [°].
        knots: directions it passes, evenly in time; drawn evenly from a disc about the scene's gravity.
    """

    angle: float
    knots: int = 6

    def __post_init__(self):
        _check_angle("angle", self.angle)
        number("knots", self.knots, least=1, whole=True)

    def of(self, gravity: Gravity, duration: float, generator: np.random.Generator) -> Gravity:
        """See `GravityProgram.of`."""
        times, tilt = _wandering(duration, self.knots, generator)
        tilt *= np.radians(self.angle)
        return Gravity(times.tolist(), tilted(gravity.at(times), tilt).tolist())

    def reach(self, gravity: np.ndarray, duration: float) -> float:
        """See `GravityProgram.reach`."""
        return 2.0 * float(np.linalg.norm(gravity) * np.sin(0.5 * np.radians(self.angle)))


@dataclass(frozen=True)
class RandomShake(GravityProgram):
    """The ground is shaken sideways, in its own frame: an acceleration across the scene's gravity is added.

    Attributes:
        acceleration: the largest [m/s²].
        knots: accelerations it passes, evenly in time; drawn evenly from a disc, the first one zero.
    """

    acceleration: float
    knots: int = 12

    def __post_init__(self):
        number("acceleration", self.acceleration, least=0.0)
        number("knots", self.knots, least=1, whole=True)

    def of(self, gravity: Gravity, duration: float, generator: np.random.Generator) -> Gravity:
        """See `GravityProgram.of`."""
        shake_times, pushed = _wandering(duration, self.knots, generator)
        times = np.union1d(shake_times, gravity.times)
        added = np.stack([np.interp(times, shake_times, way) for way in self.acceleration * pushed.T], 1)
        values = gravity.at(times) + added @ across(gravity.at(0.0))
        return Gravity(times.tolist(), values.tolist())

    def reach(self, gravity: np.ndarray, duration: float) -> float:
        """See `GravityProgram.reach`."""
        return self.acceleration


@dataclass(frozen=True)
class RandomPress(MotionProgram):
    """A plate that presses once and lets go, from rest to rest, as deep, as fast and as far aside as drawn.

    Attributes:
        direction: [3] of the press.
        depth: smallest and largest stroke [m].
        stroke: shortest and longest time of a stroke [s].
        hold: time between the strokes [s].
        aside: the plate stands at most as far off its place [m] along `across`, all the time.
        across: [3] direction of that.
    """

    direction: Sequence[float]
    depth: Sequence[float]
    stroke: Sequence[float]
    hold: float = 0.0
    aside: float = 0.0
    across: Sequence[float] = (1.0, 0.0, 0.0)

    def __post_init__(self):
        direction("direction", self.direction)
        direction("across", self.across)
        for name, unit in (("depth", "m"), ("stroke", "s")):
            low, high = numbers(name, getattr(self, name), unit, 2)
            if not 0.0 < low <= high:
                raise ConfigError(
                    f"{name}=[{low:g}, {high:g}] {unit} must be positive, the smaller one first"
                )
        for name in ("hold", "aside"):
            number(name, getattr(self, name), least=0.0)

    def motion(self, duration: float, generator: np.random.Generator) -> Motion:
        """See `MotionProgram.motion`."""
        depth, stroke = generator.uniform(*self.depth), generator.uniform(*self.stroke)
        aside = generator.uniform(-self.aside, self.aside) * direction("across", self.across)
        share = np.linspace(0.0, 1.0, _KEYFRAMES + 1)
        way = 0.5 * (1.0 - np.cos(np.pi * share))
        times = [stroke * share, stroke * (1.0 + share) + self.hold]
        gone = [way, way[::-1]]
        if not self.hold:
            times[1], gone[1] = times[1][1:], gone[1][1:]
        d = depth * np.concatenate(gone)[:, None] * direction("direction", self.direction) + aside
        return Motion(np.concatenate(times).tolist(), d.tolist())

    def top_speed(self, duration: float) -> float:
        """See `MotionProgram.top_speed`."""
        return 0.5 * np.pi * self.depth[1] / self.stroke[0]


@dataclass(frozen=True)
class RandomPush(MotionProgram):
    """A solid that is pushed to and fro along a line, from where it stands.

    Attributes:
        direction: [3] of the line.
        reach: [m] how far back and how far forth, as [-0.01, 0.05].
        knots: places it passes, evenly in time.
    """

    direction: Sequence[float]
    reach: Sequence[float]
    knots: int = 6

    def __post_init__(self):
        direction("direction", self.direction)
        low, high = numbers("reach", self.reach, "m", 2)
        if not low <= 0.0 <= high or low == high:
            raise ConfigError(f"reach=[{low:g}, {high:g}] m must go back and forth from 0, as [-0.01, 0.05]")
        number("knots", self.knots, least=1, whole=True)

    def motion(self, duration: float, generator: np.random.Generator) -> Motion:
        """See `MotionProgram.motion`."""
        knots = np.concatenate([[0.0], generator.uniform(*self.reach, self.knots)])
        times = np.linspace(0.0, duration, _KEYFRAMES * self.knots + 1)
        d = _through(knots, times, duration)[:, None] * direction("direction", self.direction)
        return Motion(times.tolist(), d.tolist())

    def top_speed(self, duration: float) -> float:
        """See `MotionProgram.top_speed`."""
        return 3.0 * (self.reach[1] - self.reach[0]) * self.knots / duration  # of a monotone cubic


@dataclass(frozen=True)
class Programs:
    """The programs of a scene.

    Attributes:
        gravity: by name, applied in order; colliders: by the collider's name.
    """

    gravity: Mapping[str, GravityProgram] = field(default_factory=dict)
    colliders: Mapping[str, MotionProgram] = field(default_factory=dict)

    def __bool__(self) -> bool:
        return bool(self.gravity or self.colliders)

    def gravity_of(self, gravity: Sequence[float], duration: float, program: int) -> Gravity:
        """The gravity of one run.

        Args:
            gravity: [3] of the scene [m/s²].
            duration: of the run [s].
            program: its number.
        """
        acting = Gravity.constant(gravity)
        for name, change in self.gravity.items():
            acting = change.of(acting, duration, _generator(program, f"gravity.{name}"))
            _check_made("gravity", name, change, acting, Gravity)
        return acting

    def motion_of(self, collider: str, duration: float, program: int) -> Motion | None:
        """The motion that a collider has in one run; None where no program moves it."""
        if collider not in self.colliders:
            return None
        drive = self.colliders[collider]
        motion = drive.motion(duration, _generator(program, f"colliders.{collider}"))
        _check_made("colliders", collider, drive, motion, Motion)
        return motion

    def reach(self, gravity: Sequence[float], duration: float) -> float:
        """How far from the scene's gravity [3] that of any run of some duration [s] may be [m/s²]."""
        base, far = np.asarray(gravity, float), 0.0
        down = normalised(base) if base.any() else np.array([0.0, 0.0, -1.0])
        for change in self.gravity.values():
            far += change.reach(base + far * down, duration)
        return far

    def check(
        self, names: Sequence[str], gravity: Sequence[float], duration: float, dt: float, dx: float
    ) -> None:
        """Refuse curves that fail, programs of no collider, and those that cross more than a cell in a step.

        Raises:
            ConfigError: names the program.
        """
        for change in self.gravity.values():
            if isinstance(change, GravityCurve):
                change.of(Gravity.constant(gravity), duration, np.random.default_rng(0))
        for name, drive in self.colliders.items():
            where = f"scene.forcing.colliders.{name}"
            if name not in names:
                raise ConfigError(
                    f"{where} moves a collider that does not exist; there are {', '.join(names) or 'none'}"
                )
            if (speed := drive.top_speed(duration)) * dt > dx:
                raise ConfigError(
                    f"{where} may reach {speed:.3g} m/s, more than a cell, {dx:.3g} m, a step of {dt:g} s; "
                    "let it be slower, or choose a smaller scene.dt"
                )


def _check_made(group: str, name: str, program: object, made: object, kind: type) -> None:
    if not isinstance(made, kind):
        raise ConfigError(
            f"scene.forcing.{group}.{name}: {type(program).__name__} gives a {type(made).__name__}; "
            f"return a nsf.mpm.{kind.__name__}"
        )


def _check_angle(name: str, angle: float) -> None:
    if not 0.0 < number(name, angle) <= 180.0:
        raise ConfigError(f"{name}={angle:g}° must lie between 0° and 180°")


def _generator(program: int, name: str) -> np.random.Generator:
    """Of one program of a run: independent of the others', and of how many there are."""
    return np.random.default_rng([program, crc32(name.encode())])


def _through(knots: np.ndarray, t: np.ndarray, duration: float) -> np.ndarray:
    """A smooth way [n, …] through knots [k, …] that are even in time, never beyond two neighbours."""
    from scipy.interpolate import PchipInterpolator  # SciPy takes 0.2 s to load

    return PchipInterpolator(np.linspace(0.0, duration, len(knots)), knots)(np.clip(t, 0.0, duration))


def _wandering(duration: float, knots: int, generator: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Times [n] of keyframes, and points [n, 2] of a way in the unit disc that starts in its middle."""
    radius = np.sqrt(generator.random(knots))
    angle = 2.0 * np.pi * generator.random(knots)
    passed = np.vstack([np.zeros(2), np.stack([radius * np.cos(angle), radius * np.sin(angle)], 1)])
    times = np.linspace(0.0, duration, _KEYFRAMES * knots + 1)
    way = _through(passed, times, duration)
    return times, way / np.maximum(1.0, np.linalg.norm(way, axis=1, keepdims=True))
