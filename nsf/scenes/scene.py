"""Scenes: what is simulated (paper section 6)."""

import math
import pickle
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from omegaconf import DictConfig, OmegaConf

from nsf import config as configuration
from nsf.config.resolvers import following
from nsf.data import PROGRAM, Case
from nsf.errors import ConfigError
from nsf.mpm import Collider, DomainWalls, FullOrderMPM, Gravity, GridGeometry, ParticleConstants, Transfer
from nsf.mpm.materials import Material
from nsf.scenes.checks import check_memory, check_particles, check_physics
from nsf.scenes.designs import case_of
from nsf.scenes.draft import Draft
from nsf.scenes.programs import Programs
from nsf.vectors import vector


@dataclass(frozen=True)
class Scene(Draft):
    """A full-order problem: bodies, law, boundaries, time span, problem parameters.

    Attributes:
        name, scale: what it is called.
        dx: grid spacing [m]; dt: step [s]; steps: number of steps, each a frame.
        size: domain edge lengths [m]; gravity: [3] [m/s²].
        bodies: what moves; colliders, walls: boundaries.
        material: constitutive law; transfer: PIC, APIC or RPIC.
        forcing: programs of gravity and colliders, as drawn for the run whose number `program` is.
        parameters: the problem parameters by name; design: draws the cases, the values that they take.
        config: the configuration that it was built from, resolved.
        template: the same before its interpolations were resolved.
    """

    gravity: tuple[float, float, float]
    colliders: tuple[Collider, ...]
    walls: DomainWalls
    material: Material
    transfer: Transfer
    forcing: Programs
    program: int
    _at: dict[tuple, "Scene"] = field(default_factory=dict, init=False, repr=False, compare=False)

    @classmethod
    def of(cls, draft: Draft) -> "Scene":
        """The whole scene of a draft, whose keys were checked when it was made.

        Raises:
            ConfigError: a value is outside its range.
        """
        return cls._build(draft.config, draft.template)

    @classmethod
    def _build(cls, config: DictConfig, template: DictConfig) -> "Scene":
        s = configuration.section(config, "scene")
        forcing, program = _programs(s)
        solids = configuration.build_all(s.colliders, "scene.colliders")
        own = cls._drafted(config, template)
        dx, dt, duration = own["dx"], own["dt"], own["dt"] * own["steps"]
        GridGeometry.of_domain(own["size"], dx)
        forcing.check(tuple(solids), duration, dt, dx)
        for name in forcing.colliders:
            solids[name] = replace(solids[name], motion=forcing.motion_of(name, duration, program))
        return cls(
            **own,
            gravity=vector("scene.gravity", s.gravity, "m/s²"),
            colliders=tuple(solids.values()),
            walls=configuration.build(s.walls, "scene.walls"),
            material=configuration.build(config.material, "material"),
            transfer=configuration.build(config.transfer, "transfer"),
            forcing=forcing,
            program=program,
        )

    @cached_property
    def acting_gravity(self) -> Gravity:
        """Gravity in the course of the run, as the programs have it [m/s²]."""
        return self.forcing.gravity_of(self.gravity, self.dt * self.steps, self.program)

    def forcing_at(self, t: np.ndarray) -> dict[str, np.ndarray]:
        """What forces a run at times t [n] [s].

        Returns:
            gravity: [n, 3] [m/s²]; solids: [n, c, 4] shift [m] and angle [rad] of each collider.
        """
        poses = np.zeros((len(t), len(self.colliders), 4))
        for c, solid in enumerate(self.colliders):
            if solid.motion is not None:
                poses[:, c] = solid.motion.pose(t)
        return {"gravity": self.acting_gravity.at(t), "solids": poses}

    @property
    def collider_names(self) -> tuple[str, ...]:
        """Of the colliders, in order."""
        return tuple(map(str, self.config.scene.colliders))

    def case(self, values: Mapping[str, float] | Sequence[float] | float | None = None) -> Case:
        """A case of the problem parameters.

        Args:
            values: by name, where those that are left out are as configured; or in the parameters' order; or
                the value of the only one. As configured by default.

        Raises:
            ConfigError: a name is no parameter of the scene, or a value no finite number.
        """
        if values is None or isinstance(values, Mapping):
            configured = {
                name: OmegaConf.select(self.config, parameter.key) for name, parameter in self.varied.items()
            }
            values = configured | dict(values or {})
        if not isinstance(values, Mapping):
            values = np.atleast_1d(values).tolist()
            if self.forcing and len(values) == len(self.parameters):
                values.append(self.program)
        return case_of(self.varied, values, self.name)

    def with_parameters(self, parameters: Mapping[str, float]) -> "Scene":
        """The same scene at given problem parameters, `{name: value}`; keys that refer to them follow.

        Raises:
            ConfigError: a name is none of the scene's parameters, or a value is refused.
        """
        if (asked := tuple(parameters.items())) in self._at:
            return self._at[asked]
        values = {}
        for name, value in parameters.items():
            if name not in self.varied:
                raise ConfigError(
                    f"{self.name} has no parameter {name!r}; there are {', '.join(self.varied)}"
                )
            if not (isinstance(value, int | float | np.number) and math.isfinite(value)):
                raise ConfigError(f"{name}={value!r} must be a finite number")
            values[self.varied[name].key] = int(value) if name == PROGRAM else float(value)
        config, template = pickle.loads(self._packed)
        paths = (path for name in parameters for path in self._following[name])
        config = configuration.resolve_again(template, values, config, paths)
        self._at[asked] = Scene._build(config, template)
        return self._at[asked]

    @cached_property
    def _packed(self) -> bytes:
        """Both configurations: to unpack them takes a third of what copies take."""
        return pickle.dumps((self.config, self.template))

    @cached_property
    def _following(self) -> dict[str, list[tuple[str, ...]]]:
        """Paths of the values that follow each parameter's key."""
        return {name: following(self.template, parameter.key) for name, parameter in self.varied.items()}

    def with_changes(self, changes: Mapping[str, Any]) -> "Scene":
        """The scene with other values of some configuration keys, and the same particles at rest and steps.

        A manifold of this scene can be deployed on that one: the fields are functions of the particles'
        X, and a latent vector steps by Δt on the grid.

        Args:
            changes: values by dotted key of the scene, its material or its transfer.

        Raises:
            ConfigError: a key is unknown, a problem parameter's, or one that changes X, the grid or the
                steps; a value is refused.
        """
        changed = self.changed(changes)
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

    def coarsened(self, factor: int, multiple: int = 1) -> "Scene":
        """The same scene on a grid of factor times the spacing, with as many particles a cell.

        Args:
            factor: of Δx; a body's particles become fewer by its third power.
            multiple: of Δt; it divides the steps.

        Raises:
            ConfigError: a body, a collider or the walls do not fit the coarse grid.
        """
        config = self._recounted([max(1, round(body.particles / factor**3)) for body in self.bodies])
        config.scene.dx, config.scene.dt = factor * self.dx, multiple * self.dt
        config.scene.steps = self.steps // multiple
        return Scene.from_config(config)

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

    def particles(self) -> ParticleConstants:
        """Particles of every body, in order; μ̂ and λ are the material's, times a body's weakness.

        Raises:
            ConfigError: a weak region holds no particles, or the particles do not fit into memory.
        """
        check_particles(self.particle_count)
        X, mass, volume0, stiffness = [], [], [], []
        for body in self.bodies:
            volume = body.shape.volume / body.particles
            X.append(body.points())
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
            parameters: problem parameters `{name: value}`; those left out are as configured.
            precision: `fp64` or `fp32`.
            device: `cpu`, `cuda`, `cuda:N` or `auto`.

        Raises:
            ConfigError: the simulation does not fit into memory, or the scene cannot be meant
                (`nsf.scenes.checks`); and see `FullOrderMPM`.
            InstabilityError, DeviceError: see `FullOrderMPM`.
        """
        return self.with_parameters(parameters or {}).solver(precision, device)

    def solver(self, precision: str = "fp64", device: str = "auto") -> FullOrderMPM:
        """The same of the scene as it stands, though its configuration may say another thing."""
        check_memory(self, precision, device)
        check_physics(self)
        return FullOrderMPM(
            self.particles(),
            self.material,
            self.grid,
            self.dt,
            gravity=self.acting_gravity,
            colliders=self.colliders,
            walls=self.walls,
            transfer=self.transfer,
            v=self.initial_velocity(),
            precision=precision,
            device=device,
            names=self.collider_names,
        )

    def reduced(self, manifold, parameters: Mapping[str, float] | None = None, sample=None, **options):
        """The reduced solver at t = 0 (paper section 5): same `step` and `state` as the full-order one.

        Args:
            manifold: a trained `nsf.Manifold` of these particles.
            parameters: problem parameters `{name: value}`.
            sample: indices of the sample particles S, or their number.
            **options: see `nsf.engines.reduced`; `engine` says how steps are computed.
        """
        from nsf import engines

        return engines.reduced(self, manifold, parameters, sample, **options)

    def reduced_batch(self, manifold, parameters: Sequence[Mapping[str, float]], sample=None, **options):
        """Reduced runs at t = 0 that take their steps together, one for each `{name: value}`.

        Args:
            manifold, sample: as for `reduced`.
            parameters: problem parameters of each.
            **options: see `nsf.engines.reduced_batch`.
        """
        from nsf import engines

        return engines.reduced_batch(self, manifold, parameters, sample, **options)


def _programs(s: DictConfig) -> tuple[Programs, int]:
    """The programs of a scene's configuration, and the number of the one that it follows."""
    node = s.get("forcing") or {}
    if not isinstance(node, Mapping) or not set(node) <= {"gravity", "colliders"}:
        raise ConfigError(
            f"scene.forcing={node} must have the keys gravity and colliders, each with programs by name"
        )
    found = Programs(
        configuration.build_all(node.get("gravity", {}), "scene.forcing.gravity"),
        configuration.build_all(node.get("colliders", {}), "scene.forcing.colliders"),
    )
    return found, int(configuration.number("scene.program", s.get("program", 0), least=0, whole=True))
