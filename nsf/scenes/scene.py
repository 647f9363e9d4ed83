"""Scenes: what is simulated (paper section 6)."""

import functools
import math
from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field, replace
from typing import Any

import numpy as np
from omegaconf import DictConfig, OmegaConf

from nsf import config as configuration
from nsf.errors import ConfigError
from nsf.mpm import Collider, DomainWalls, FullOrderMPM, GridGeometry, ParticleConstants, Transfer
from nsf.mpm.materials import Material
from nsf.scenes.geometry import Shape
from nsf.scenes.parameters import ParameterRange, check_key
from nsf.scenes.weakness import Weakness
from nsf.targets import filled
from nsf.vectors import vector

#: Keys of a scene that its simulation does not depend on.
NOT_PHYSICS = ("parameters", "reduced", "paper", "title")


@dataclass(frozen=True)
class Body:
    """Particles of one shape.

    Attributes:
        shape: where the particles are at rest.
        density: reference density [kg/m³].
        particles: how many; or
        particles_per_cell: how many in a grid cell's volume. Exactly one of the two; a body of a
            `Scene` has `particles`.
        velocity: initial velocity [m/s].
        weakness: particles that are softer than the material; none by default.

    Raises:
        ConfigError: not one of the two numbers, or one that is not positive; a density that is not
            positive; a velocity that is not 3 numbers.
    """

    shape: Shape
    _: KW_ONLY
    density: float
    particles: int | None = None
    particles_per_cell: float | None = None
    velocity: Sequence[float] = (0.0, 0.0, 0.0)
    weakness: Weakness | None = None

    def __post_init__(self):
        if (self.particles is None) == (self.particles_per_cell is None):
            raise ConfigError(
                f"particles={self.particles} and particles_per_cell={self.particles_per_cell}: "
                "give exactly one, the other null"
            )
        if self.particles is not None and (self.particles < 1 or self.particles != int(self.particles)):
            raise ConfigError(f"particles={self.particles} must be a whole number, at least 1")
        if self.particles_per_cell is not None and not 0 < self.particles_per_cell < math.inf:
            raise ConfigError(f"particles_per_cell={self.particles_per_cell} must be positive and finite")
        for key, kind in (("shape", Shape), ("weakness", Weakness | None)):
            if not isinstance(getattr(self, key), kind):
                raise ConfigError(
                    f"{key}={getattr(self, key)} must be built; give it a _target_: nsf.scenes.…"
                )
        if not self.density > 0:
            raise ConfigError(f"density={self.density} kg/m³ must be positive")
        vector("velocity", self.velocity, "m/s")

    def counted(self, dx: float) -> "Body":
        """The same body with `particles`, on a grid of spacing dx [m].

        Raises:
            ConfigError: the body is so small that it gets no particle.
        """
        if self.particles is not None:
            return self
        cells = self.shape.volume / dx**3
        count = round(self.particles_per_cell * cells)
        if count < 1:
            raise ConfigError(
                f"particles_per_cell={self.particles_per_cell} gives no particle: the body fills {cells:.2g} "
                f"of a cell of dx={dx:g} m; enlarge the body or refine dx"
            )
        return replace(self, particles=count, particles_per_cell=None)

    @property
    def files(self) -> dict[str, str]:
        """Path and sha256 of every file that the body is made from."""
        return self.shape.files | (self.weakness.region.files if self.weakness else {})


@dataclass(frozen=True)
class _Placing:
    """What the points of a body depend on; hashed by its text, as shapes hold lists."""

    shape: Shape
    particles: int
    files: tuple[str, ...]

    def __hash__(self):
        return hash((repr(self.shape), self.particles, self.files))


@functools.lru_cache(maxsize=8)
def _points(placing: _Placing) -> np.ndarray:
    """[P, 3] points at rest [m]; placing is slow, and a scene's parameter values share their bodies."""
    return placing.shape.sample(placing.particles)


@dataclass(frozen=True)
class Scene:
    """A full-order problem: bodies, law, boundaries, time span, problem parameter.

    Attributes:
        name, scale: what it is called.
        dx: grid spacing [m]; dt: step [s]; steps: number of steps, each a frame.
        size: domain edge lengths [m]; gravity: [3] [m/s²].
        bodies: what moves; colliders, walls: boundaries.
        material: constitutive law; transfer: PIC, APIC or RPIC.
        parameters: the problem parameter and its values.
        config: the configuration that it was built from, resolved.
        template: the same before its interpolations were resolved.
    """

    name: str
    scale: str
    dx: float
    dt: float
    steps: int
    size: tuple[float, float, float]
    gravity: tuple[float, float, float]
    bodies: tuple[Body, ...]
    colliders: tuple[Collider, ...]
    walls: DomainWalls
    material: Material
    transfer: Transfer
    parameters: ParameterRange
    config: DictConfig = field(repr=False, compare=False)
    template: DictConfig = field(repr=False, compare=False)
    _at: dict[tuple, "Scene"] = field(default_factory=dict, init=False, repr=False, compare=False)

    @classmethod
    def from_config(cls, config: DictConfig) -> "Scene":
        """Build from a configuration with `scale`, `scene`, `material`, `transfer`.

        Raises:
            ConfigError: a key is unknown or a value outside its range.
        """
        with configuration.naming_the_missing():
            found = cls._build(configuration.resolve(config), config)
        check_key(found.parameters.key, found.parameters.values, config)
        return found

    @classmethod
    def _build(cls, config: DictConfig, template: DictConfig) -> "Scene":
        s = configuration.section(config, "scene")
        configuration.text("scene.title", s.title)
        colliders = tuple(configuration.build_all(s.colliders, "scene.colliders").values())
        bodies = configuration.build_all(s.bodies, "scene.bodies").values()
        if not bodies:
            raise ConfigError("scene.bodies={} leaves nothing to simulate; give a body")
        dx = float(configuration.length("scene.dx", s.dx))
        return cls(
            name=configuration.text("scene.name", s.name),
            scale=config.scale,
            dx=dx,
            dt=float(configuration.number("scene.dt", s.dt)),
            steps=configuration.number("scene.steps", s.steps, least=1, whole=True),
            size=tuple(configuration.length("scene.size", a) for a in vector("scene.size", s.size, "m")),
            gravity=vector("scene.gravity", s.gravity, "m/s²"),
            bodies=tuple(body.counted(dx) for body in bodies),
            colliders=colliders,
            walls=configuration.build(s.walls, "scene.walls"),
            material=configuration.build(config.material, "material"),
            transfer=configuration.build(config.transfer, "transfer"),
            parameters=filled(
                ParameterRange,
                OmegaConf.to_container(configuration.section(config, "scene.parameters")),
                "scene.parameters",
            ),
            config=config,
            template=template,
        )

    def with_parameters(self, parameters: Mapping[str, float]) -> "Scene":
        """The same scene at given problem parameters, `{name: value}`; keys that refer to them follow.

        Raises:
            ConfigError: a name is not the scene's parameter, or the value is refused.
        """
        if (asked := tuple(parameters.items())) in self._at:
            return self._at[asked]
        config = self.template.copy()
        for name, value in parameters.items():
            if name != self.parameters.name:
                raise ConfigError(
                    f"{self.name} has no parameter {name!r}; its parameter is {self.parameters.name!r}"
                )
            if not (isinstance(value, int | float | np.number) and math.isfinite(value)):
                raise ConfigError(f"{name}={value!r} must be a finite number")
            OmegaConf.update(config, self.parameters.key, float(value))
        self._at[asked] = Scene._build(configuration.resolve(config), config)
        return self._at[asked]

    def with_changes(self, changes: Mapping[str, Any]) -> "Scene":
        """The scene with other values of some configuration keys, and the same particles at rest and steps.

        A manifold of this scene can be deployed on that one: the fields are functions of the particles'
        X, and a latent vector steps by Δt on the grid.

        Args:
            changes: values by dotted key of the scene, its material or its transfer.

        Raises:
            ConfigError: a key is unknown, the problem parameter's, or one that changes X, the grid or the
                steps; a value is refused.
        """
        if self.parameters.key in changes:
            raise ConfigError(f"{self.parameters.key} is the problem parameter; set scene.parameters.test")
        plain = OmegaConf.to_container(self.config)
        plain["scene"] = {k: v for k, v in plain["scene"].items() if k not in ("name", *NOT_PHYSICS)}
        known = configuration.leaves({part: plain[part] for part in ("scene", "material", "transfer")})
        changed = Scene.from_config(configuration.replaced(self.template, changes, known))
        kept = {
            "particles": np.array_equal(changed.particles().X, self.particles().X),
            "grid nodes": (changed.grid, changed.size) == (self.grid, self.size),
            "time steps": (changed.dt, changed.steps) == (self.dt, self.steps),
        }
        other = [what for what, same in kept.items() if not same]
        if other:
            raise ConfigError(
                f"{', '.join(changes)} gives other {', '.join(other)} than the manifold is trained on; "
                f"set it for the whole chain, {next(iter(changes))}=…"
            )
        return changed

    def refined(self, factor: int, substeps: int = 1) -> "Scene":
        """The same scene with factor times the particles on the same grid; a body's own come first in it.

        Weak elements are drawn anew, as there are others to draw from: their share stays.

        Args:
            factor: particles for each particle.
            substeps: steps for each step.
        """
        config = self._recounted([factor * body.particles for body in self.bodies])
        config.scene.dt, config.scene.steps = self.dt / substeps, substeps * self.steps
        return Scene.from_config(config)

    def resampled(self, particles: int) -> "Scene":
        """The same scene with that many particles, each body with its share of them.

        A body's own particles come first in it, if it gets more; weak elements are drawn anew.

        Raises:
            ConfigError: a body's share is less than one particle.
        """
        ends = np.cumsum([0] + [body.particles for body in self.bodies])
        return Scene.from_config(self._recounted(np.diff(np.rint(particles * (ends / ends[-1])))))

    def _recounted(self, counts: Sequence[int]) -> DictConfig:
        """The configuration with other numbers of particles of the bodies."""
        config = self.template.copy()
        for name, count in zip(self.config.scene.bodies, counts, strict=True):
            node = config.scene.bodies[name]
            node.particles, node.particles_per_cell = int(count), None
        return config

    @property
    def grid(self) -> GridGeometry:
        """The background grid."""
        return GridGeometry.of_domain(self.size, self.dx)

    @property
    def files(self) -> dict[str, str]:
        """Path and sha256 of every file that the scene is made from beyond its configuration."""
        return {path: digest for body in self.bodies for path, digest in body.files.items()}

    def particles(self) -> ParticleConstants:
        """Particles of every body, in order; μ̂ and λ are the material's, times a body's weakness.

        Raises:
            ConfigError: a body reaches outside the domain, or a weak region holds no particles.
        """
        X, mass, volume0, stiffness = [], [], [], []
        for body in self.bodies:
            lower, upper = body.shape.bounds
            if (lower < 0).any() or (upper > np.asarray(self.size)).any():
                raise ConfigError(
                    f"body from {lower} to {upper} m reaches outside the domain [0, {self.size}] m; "
                    "move it or make it smaller"
                )
            volume = body.shape.volume / body.particles
            X.append(_points(_Placing(body.shape, body.particles, tuple(body.shape.files.values()))))
            volume0.append(np.full(body.particles, volume))
            mass.append(np.full(body.particles, body.density * volume))
            stiffness.append(body.weakness.of(X[-1]) if body.weakness else np.ones(body.particles))
        stiffness = np.concatenate(stiffness)
        mu, lam = stiffness * self.material.mu, stiffness * self.material.lam
        return ParticleConstants(np.concatenate(X), np.concatenate(mass), np.concatenate(volume0), mu, lam)

    def initial_velocity(self) -> np.ndarray:
        """[P, 3] velocity at t = 0 [m/s]."""
        return np.concatenate([np.tile(np.asarray(b.velocity, float), (b.particles, 1)) for b in self.bodies])

    def full_order(
        self, parameters: Mapping[str, float] | None = None, precision: str = "fp64", device: str = "auto"
    ) -> FullOrderMPM:
        """The full-order solver at t = 0 (paper section 3).

        Args:
            parameters: problem parameters `{name: value}`; the configured value by default.
            precision: `fp64` or `fp32`.
            device: `cpu`, `cuda`, `cuda:N` or `auto`.

        Raises:
            ConfigError, InstabilityError, DeviceError: see `FullOrderMPM`.
        """
        scene = self.with_parameters(parameters or {})
        return FullOrderMPM(
            scene.particles(),
            scene.material,
            scene.grid,
            scene.dt,
            gravity=scene.gravity,
            colliders=scene.colliders,
            walls=scene.walls,
            transfer=scene.transfer,
            v=scene.initial_velocity(),
            precision=precision,
            device=device,
        )

    def reduced(self, manifold, parameters: Mapping[str, float] | None = None, sample=None, **options):
        """The reduced solver at t = 0 (paper section 5): same `step` and `state` as the full-order one.

        Args:
            manifold: a trained `nsf.Manifold` of these particles.
            parameters: problem parameters `{name: value}`.
            sample: indices of the sample particles S, or their number.
            **options: see `nsf.dynamics.ReducedMPM.of_scene`.
        """
        from nsf.dynamics import ReducedMPM

        return ReducedMPM.of_scene(self, manifold, parameters, sample, **options)

    def reduced_batch(self, manifold, parameters: Sequence[Mapping[str, float]], sample=None, **options):
        """Reduced solvers at t = 0 that take their steps in the same launches, one for each `{name: value}`.

        Args:
            manifold, sample: as for `reduced`.
            parameters: problem parameters of each.
            **options: see `nsf.dynamics.ReducedBatch.of_scene`.
        """
        from nsf.dynamics import ReducedBatch

        return ReducedBatch.of_scene(self, manifold, parameters, sample, **options)
