"""A scene as its configuration has it, before anything of the physics is built.

Names of runs, and most mistakes in a configuration, need no more. Neither Warp nor torch is imported.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Self

from omegaconf import DictConfig, OmegaConf

from nsf import config as configuration
from nsf.data.case import PROGRAM
from nsf.data.split import Split
from nsf.errors import ConfigError
from nsf.scenes.body import Body
from nsf.scenes.designs import Design
from nsf.scenes.identity import NOT_PHYSICS
from nsf.scenes.parameters import Parameter, check_key, parameters_of
from nsf.vectors import vector


@dataclass(frozen=True)
class Draft:
    """Bodies, grid spacing, time span and problem parameters of a scene.

    Attributes:
        name, scale: what it is called.
        dx: grid spacing [m]; dt: step [s]; steps: number of steps, each a frame.
        size: domain edge lengths [m].
        bodies: what moves.
        parameters: the problem parameters by name; design: draws the cases, the values that they take.
        config: the configuration that it was built from, resolved.
        template: the same before its interpolations were resolved.
    """

    name: str
    scale: str
    dx: float
    dt: float
    steps: int
    size: tuple[float, float, float]
    bodies: tuple[Body, ...]
    parameters: Mapping[str, Parameter]
    design: Design
    config: DictConfig = field(repr=False, compare=False)
    template: DictConfig = field(repr=False, compare=False)

    @classmethod
    def from_config(cls, config: DictConfig) -> Self:
        """Build from a configuration with `scale`, `scene`, `material`, `transfer`.

        Raises:
            ConfigError: a key is unknown or a value outside its range.
        """
        with configuration.naming_the_missing():
            found = cls._build(configuration.resolve(config), config)
        for name, parameter in found.parameters.items():
            check_key(name, parameter.key, [case[name] for case in found.split.cases], found.config, config)
        return found

    @classmethod
    def _build(cls, config: DictConfig, template: DictConfig) -> Self:
        return cls(**cls._drafted(config, template))

    @classmethod
    def _drafted(cls, config: DictConfig, template: DictConfig) -> dict[str, Any]:
        """The attributes of a draft."""
        s = configuration.section(config, "scene")
        if "title" in s:  # the configuration of a simulation has none
            configuration.text("scene.title", s.title)
        dx = float(configuration.length("scene.dx", s.dx))
        size = tuple(configuration.length("scene.size", a) for a in vector("scene.size", s.size, "m"))
        bodies = configuration.build_all(s.bodies, "scene.bodies")
        if not bodies:
            raise ConfigError("scene.bodies={} leaves nothing to simulate; give a body")
        return {
            "name": configuration.text("scene.name", s.name),
            "scale": config.scale,
            "dx": dx,
            "dt": float(configuration.number("scene.dt", s.dt)),
            "steps": configuration.number("scene.steps", s.steps, least=1, whole=True),
            "size": size,
            "bodies": tuple(_body(b, f"scene.bodies.{n}", size, dx) for n, b in bodies.items()),
            "parameters": parameters_of(
                OmegaConf.to_container(configuration.section(config, "scene.parameters"))
            ),
            "design": configuration.build(configuration.section(config, "scene.design"), "scene.design"),
            "config": config,
            "template": template,
        }

    @cached_property
    def split(self) -> Split:
        """The cases that the design draws, by their use.

        Raises:
            ConfigError: see `Design.split`.
        """
        return self.design.split(self.varied)

    @cached_property
    def varied(self) -> dict[str, Parameter]:
        """What a case has a value of: the problem parameters, and the program's number if there is any."""
        node = self.config.scene.get("forcing")
        forced = isinstance(node, Mapping) and any(node.values())
        return dict(self.parameters) | ({PROGRAM: Parameter("scene.program", "")} if forced else {})

    @cached_property
    def plain(self) -> dict[str, Any]:
        """The resolved configuration as plain containers, to be read and not changed."""
        return OmegaConf.to_container(self.config)

    @property
    def particle_count(self) -> int:
        """Particles of all bodies together."""
        return sum(body.particles for body in self.bodies)

    @property
    def files(self) -> dict[str, str]:
        """Path and sha256 of every file that the scene is made from beyond its configuration."""
        return {path: digest for body in self.bodies for path, digest in body.files.items()}

    def changed(self, changes: Mapping[str, Any]) -> Self:
        """The scene with other values of some configuration keys.

        Args:
            changes: values by dotted key of the scene, its material or its transfer.

        Raises:
            ConfigError: a key is unknown or a problem parameter's; a value is refused.
        """
        if own := [p.key for p in self.parameters.values() if p.key in changes]:
            raise ConfigError(f"{own[0]} is a problem parameter; set scene.design.test")
        plain = OmegaConf.to_container(self.config)
        plain["scene"] = {k: v for k, v in plain["scene"].items() if k not in ("name", *NOT_PHYSICS)}
        known = configuration.leaves({part: plain[part] for part in ("scene", "material", "transfer")})
        return self.from_config(configuration.replaced(self.template, changes, known))


def _body(body: Body, where: str, size: Sequence[float], dx: float) -> Body:
    """A body that the grid can hold, with its number of particles."""
    try:
        body.check_extent(size, dx)
        return body.counted(dx)
    except ConfigError as error:
        raise ConfigError(f"{where}: {error}") from error
