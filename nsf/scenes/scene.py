"""Scenes: what is simulated (paper section 6)."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from nsf.data import PROGRAM, Case, Split
from nsf.errors import ConfigError
from nsf.mpm import Collider, DomainWalls, Gravity, GridGeometry, ParticleConstants, Transfer
from nsf.mpm.materials import Material
from nsf.scalars import length, number, text
from nsf.scenes.body import Body
from nsf.scenes.checks import check_memory, check_particles, check_physics
from nsf.scenes.designs import Design, case_of
from nsf.scenes.inclination import Inclination
from nsf.scenes.parameters import Parameter, check_parameters
from nsf.scenes.paths import parts_of, value_at, with_value
from nsf.scenes.programs import Programs
from nsf.vectors import vector

if TYPE_CHECKING:
    from nsf.mpm import FullOrderMPM


@dataclass(frozen=True, kw_only=True)
class Scene:
    """A full-order problem: bodies, law, boundaries, time span, problem parameters.

    Attributes:
        name: what it is called; a folder's name.
        dx: grid spacing [m]; dt: step [s]; steps: number of steps, each a frame.
        bodies: what moves, by name.
        material: constitutive law; transfer: PIC, APIC or RPIC.
        size: domain edge lengths [m].
        gravity: [3] [m/s²]; inclination: of the scene's frame, in which gravity and velocities are turned.
        colliders: solids by name; walls: of the domain.
        forcing: programs of gravity and colliders, as drawn for the run whose number `program` is.
        parameters: the problem parameters by name; design: draws the cases, the values that they take.

    Raises:
        ConfigError: a value is outside its range, a body does not fit into the domain, a program moves no
            collider, or a parameter replaces no number of the physics.
    """

    name: str
    dx: float
    dt: float
    steps: int
    bodies: Mapping[str, Body]
    material: Material
    transfer: Transfer = field(default_factory=Transfer)
    size: Sequence[float] = (1.0, 1.0, 1.0)
    gravity: Sequence[float] = (0.0, 0.0, -9.81)
    inclination: Inclination | None = None
    colliders: Mapping[str, Collider] = field(default_factory=dict)
    walls: DomainWalls = field(default_factory=DomainWalls)
    forcing: Programs = field(default_factory=Programs)
    program: int = 0
    parameters: Mapping[str, Parameter] = field(default_factory=dict)
    design: Design | None = None

    def __post_init__(self):
        text("scene.name", self.name)
        if not number("scene.dt", self.dt) > 0:
            raise ConfigError(f"scene.dt={self.dt} s must be positive")
        number("scene.steps", self.steps, least=1, whole=True)
        number("scene.program", self.program, least=0, whole=True)
        size = tuple(length("scene.size", edge) for edge in vector("scene.size", self.size, "m"))
        self._set(dx=float(length("scene.dx", self.dx)), dt=float(self.dt), size=size)
        self._set(gravity=vector("scene.gravity", self.gravity, "m/s²"))
        if not self.bodies:
            raise ConfigError("scene.bodies={} leaves nothing to simulate; give a body")
        self._set(bodies={name: self._fitted(name, body) for name, body in self.bodies.items()})
        GridGeometry.of_domain(self.size, self.dx)
        self.forcing.check(tuple(self.colliders), self.gravity, self.duration, self.dt, self.dx)
        check_parameters(self, self.parameters)

    def _set(self, **values: Any) -> None:
        for name, value in values.items():
            object.__setattr__(self, name, value)

    def _fitted(self, name: str, body: Body) -> Body:
        """A body that the grid can hold, with its number of particles."""
        try:
            body.check_extent(self.size, self.dx)
            return body.counted(self.dx)
        except ConfigError as error:
            raise ConfigError(f"scene.bodies.{name}: {error}") from error

    @property
    def duration(self) -> float:
        """Of a run [s]."""
        return self.dt * self.steps

    @property
    def base_gravity(self) -> tuple[float, float, float]:
        """[3] gravity in the scene's frame, before any program changes it [m/s²]."""
        return self.inclination.turned(self.gravity) if self.inclination else self.gravity

    @cached_property
    def acting_gravity(self) -> Gravity:
        """Gravity in the course of the run, as the programs have it [m/s²]."""
        return self.forcing.gravity_of(self.base_gravity, self.duration, self.program)

    @cached_property
    def solids(self) -> tuple[Collider, ...]:
        """The colliders in the course of the run, in order, moved as the programs have it."""
        moved = {name: self.forcing.motion_of(name, self.duration, self.program) for name in self.colliders}
        return tuple(
            solid if moved[name] is None else replace(solid, motion=moved[name])
            for name, solid in self.colliders.items()
        )

    def forcing_at(self, t: np.ndarray) -> dict[str, np.ndarray]:
        """The forcing of a run at times t [n] [s].

        Returns:
            gravity: [n, 3] [m/s²]; solids: [n, c, 4] shift [m] and angle [rad] of each collider.
        """
        poses = np.zeros((len(t), len(self.solids), 4))
        for c, solid in enumerate(self.solids):
            if solid.motion is not None:
                poses[:, c] = solid.motion.pose(t)
        return {"gravity": self.acting_gravity.at(t), "solids": poses}

    @cached_property
    def varied(self) -> dict[str, Parameter]:
        """Names of the values of a case: the problem parameters, and the program's number if there is any."""
        return dict(self.parameters) | ({PROGRAM: Parameter(f"scene.{PROGRAM}", "")} if self.forcing else {})

    @cached_property
    def split(self) -> Split:
        """The cases that the design draws, by their use.

        Raises:
            ConfigError: there is no design, or no parameter to vary; and see `Design.split`.
        """
        if self.design is None or not self.parameters:
            raise ConfigError(f"scene {self.name} has no parameters or no design; give it both to draw cases")
        return self.design.split(self.varied)

    def case(self, values: Mapping[str, float] | Sequence[float] | float | None = None) -> Case:
        """A case of the problem parameters.

        Args:
            values: by name, where those that are left out are as the scene has them; or in the parameters'
                order; or the value of the only one. As the scene has them by default.

        Raises:
            ConfigError: a name is no parameter of the scene, or a value no finite number.
        """
        if values is None or isinstance(values, Mapping):
            scene_values = {name: value_at(self, parameter.path) for name, parameter in self.varied.items()}
            values = scene_values | dict(values or {})
        if not isinstance(values, Mapping):
            values = np.atleast_1d(values).tolist()
            if self.forcing and len(values) == len(self.parameters):
                values.append(self.program)
        return case_of(self.varied, values, self.name)

    def at(self, case: Mapping[str, float]) -> Self:
        """The same scene at values of problem parameters, `{name: value}`.

        Raises:
            ConfigError: a name is none of the scene's parameters, or a value is refused.
        """
        values = {}
        for name, value in case.items():
            if name not in self.varied:
                raise ConfigError(
                    f"{self.name} has no parameter {name!r}; there are {', '.join(self.varied)}"
                )
            if not (isinstance(value, int | float | np.number) and math.isfinite(value)):
                raise ConfigError(f"{name}={value!r} must be a finite number")
            key = self.varied[name].key
            whole = type(value_at(self, parts_of(key))) is int and value == int(value)
            values[key] = int(value) if whole else float(value)
        return self.changed(values)

    def changed(self, values: Mapping[str, Any]) -> Self:
        """The same scene with other values, by key path, as `{"bodies.cube.density": 80.0}`.

        Raises:
            ConfigError: the scene has no such key, or a value is refused.
        """
        changed: dict[str, Any] = {}
        for key, value in values.items():
            first, *rest = path = parts_of(key)
            try:
                value_at(self, path)
            except KeyError as error:
                raise ConfigError(
                    f"scene {self.name} has no {key!r}: there is no {error.args[0]!r}"
                ) from error
            changed[first] = with_value(changed.get(first, getattr(self, first)), rest, value, first)
        return replace(self, **changed)

    def refined(self, factor: int, substeps: int = 1) -> Self:
        """The same scene with factor times the particles on the same grid; a body's own come first in it.

        Weak elements are drawn anew, as there are others to draw from: their share stays.

        Args:
            factor: particles for each particle.
            substeps: steps for each step.
        """
        bodies = self._recounted([factor * body.particles for body in self.bodies.values()])
        return replace(self, bodies=bodies, dt=self.dt / substeps, steps=substeps * self.steps)

    def resampled(self, particles: int) -> Self:
        """The same scene with that many particles, each body with its share of them.

        A body's own particles come first in it, if it gets more; weak elements are drawn anew.

        Raises:
            ConfigError: a body's share is less than one particle.
        """
        ends = np.cumsum([0] + [body.particles for body in self.bodies.values()])
        return replace(self, bodies=self._recounted(np.diff(np.rint(particles * (ends / ends[-1])))))

    def coarsened(self, factor: float, multiple: float = 1) -> Self:
        """The same scene on a grid of factor times the spacing, with as many particles a cell.

        Args:
            factor: of Δx, below 1 for a finer grid; a body's particles become fewer by its third power.
            multiple: of Δt; it divides the steps.

        Raises:
            ConfigError: a body, a collider or the walls do not fit the coarse grid, or the steps are no
                whole number of larger ones.
        """
        steps = self.steps / multiple
        if not math.isclose(steps, round(steps), rel_tol=1e-9):
            raise ConfigError(
                f"multiple={multiple:g} does not divide scene.steps={self.steps}; set one that does"
            )
        counts = [max(1, round(body.particles / factor**3)) for body in self.bodies.values()]
        return replace(
            self,
            bodies=self._recounted(counts),
            dx=factor * self.dx,
            dt=multiple * self.dt,
            steps=round(steps),
        )

    def _recounted(self, counts: Sequence[float]) -> dict[str, Body]:
        """The bodies with other numbers of particles."""
        pairs = zip(self.bodies.items(), counts, strict=True)
        return {name: replace(body, particles=int(count)) for (name, body), count in pairs}

    @property
    def grid(self) -> GridGeometry:
        """The background grid."""
        return GridGeometry.of_domain(self.size, self.dx)

    @property
    def particle_count(self) -> int:
        """Particles of all bodies together."""
        return sum(body.particles for body in self.bodies.values())

    @property
    def files(self) -> dict[str, str]:
        """Path and sha256 of every file that the scene is made from."""
        return {path: digest for body in self.bodies.values() for path, digest in body.files.items()}

    def particles(self) -> ParticleConstants:
        """Particles of every body, in order; μ̂ and λ are the material's, times a body's weakness.

        Raises:
            ConfigError: a weak region holds no particles, or the particles do not fit into memory.
        """
        check_particles(self.particle_count)
        X, mass, volume0, stiffness = [], [], [], []
        for body in self.bodies.values():
            volume = body.shape.volume / body.particles
            X.append(body.points())
            volume0.append(np.full(body.particles, volume))
            mass.append(np.full(body.particles, body.density * volume))
            stiffness.append(body.weakness.of(X[-1]) if body.weakness else np.ones(body.particles))
        stiffness = np.concatenate(stiffness)
        mu, lam = stiffness * self.material.mu, stiffness * self.material.lam
        return ParticleConstants(np.concatenate(X), np.concatenate(mass), np.concatenate(volume0), mu, lam)

    def initial_velocity(self) -> np.ndarray:
        """[P, 3] velocity at t = 0, in the scene's frame [m/s]."""
        turned = self.inclination.turned if self.inclination else lambda upright: upright
        return np.concatenate(
            [np.tile(np.asarray(turned(b.velocity), float), (b.particles, 1)) for b in self.bodies.values()]
        )

    def full_order(
        self, parameters: Mapping[str, float] | None = None, precision: str = "fp64", device: str = "auto"
    ) -> "FullOrderMPM":
        """The full-order solver at t = 0 (paper section 3).

        Args:
            parameters: problem parameters `{name: value}`; those left out are as the scene has them.
            precision: `fp64` or `fp32`.
            device: `cpu`, `cuda`, `cuda:N` or `auto`.

        Raises:
            ConfigError: the simulation does not fit into memory, or the scene cannot be meant
                (`nsf.scenes.checks`); and see `FullOrderMPM`.
            InstabilityError, DeviceError: see `FullOrderMPM`.
        """
        from nsf.mpm import FullOrderMPM

        scene = self.at(parameters or {})
        check_memory(scene, precision, device)
        check_physics(scene)
        return FullOrderMPM(
            scene.particles(),
            scene.material,
            scene.grid,
            scene.dt,
            gravity=scene.acting_gravity,
            colliders=scene.solids,
            walls=scene.walls,
            transfer=scene.transfer,
            v=scene.initial_velocity(),
            precision=precision,
            device=device,
            names=tuple(scene.colliders),
        )
