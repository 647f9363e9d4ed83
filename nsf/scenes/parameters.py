"""The problem parameter of a scene: the key that it replaces, and the values it takes (paper section 4.1)."""

import re
from collections.abc import Sequence
from dataclasses import dataclass

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from nsf import config as configuration
from nsf.config.resolvers import leaves
from nsf.errors import ConfigError
from nsf.vectors import number

#: Keys that the physics is read from; a scene may have others, which these refer to.
_PHYSICS = re.compile(r"(material|transfer|scene\.(gravity|bodies|colliders|walls))\.")
#: Keys of the particles at rest, the grid and the steps, which all values of a parameter share.
_SHARED = re.compile(r"scene\.(dx|dt|steps|size|bodies\.[^.]+\.(shape|particles|particles_per_cell))(\.|$)")


@dataclass(frozen=True)
class ParameterRange:
    """The problem parameter μ of a scene and the values it takes (paper section 4.1).

    Attributes:
        key: configuration key that the parameter replaces, for example `material.friction_angle`.
        unit: unit for tables and charts.
        train, validation, test: values; no value is in two of them.

    Raises:
        ConfigError: a list is empty where it must not be, or lists overlap.
    """

    key: str
    unit: str
    train: Sequence[float]
    test: Sequence[float]
    validation: Sequence[float] = ()

    def __post_init__(self):
        for split in ("train", "validation", "test"):
            values = getattr(self, split)
            if not isinstance(values, list | tuple):
                raise ConfigError(f"scene.parameters.{split}={values} must be a list, as [{values}]")
            for value in values:
                number(f"scene.parameters.{split}", value)
            if not values and split == "train":
                raise ConfigError("scene.parameters.train=[] must name at least one value")
        for one, other in (("train", "test"), ("train", "validation"), ("test", "validation")):
            shared = sorted(set(getattr(self, one)) & set(getattr(self, other)))
            if shared:
                raise ConfigError(
                    f"scene.parameters: {shared} is in {one} and {other}; a value belongs to one split"
                )

    @property
    def values(self) -> list[float]:
        """Those of all splits."""
        return [*self.train, *self.validation, *self.test]

    @property
    def name(self) -> str:
        """Last part of the key."""
        return self.key.rsplit(".", 1)[-1]


def check_key(key: str, values: Sequence[float], template: DictConfig) -> None:
    """Refuse a problem parameter that holds no number, or changes something else than the physics.

    Args:
        key: of the configuration.
        values: that it takes.
        template: the configuration with its interpolations, as others may refer to the key.

    Raises:
        ConfigError: says what the key changes.
    """
    remedy = "name a key of the material, the motion or the boundaries"
    config = configuration.resolve(template)
    try:
        own = OmegaConf.select(config, key) if key else None
    except OmegaConfBaseException:  # it is no key, as ../name
        own = None
    if not isinstance(own, int | float) or isinstance(own, bool):
        raise ConfigError(f"scene.parameters.key={key!r} names no key that holds a number; {remedy}")
    other = template.copy()
    OmegaConf.update(other, key, float(next(value for value in (*values, own + 1.0) if value != own)))
    before, after = (dict(leaves(OmegaConf.to_container(c))) for c in (config, configuration.resolve(other)))
    changed = [".".join(path) for path, value in after.items() if before.get(path) != value]
    if shared := [name for name in changed if _SHARED.match(name)]:
        raise ConfigError(
            f"scene.parameters.key={key} changes {shared[0]}, but all values share the particles at rest, "
            f"the grid and the steps; {remedy}"
        )
    if not any(map(_PHYSICS.match, changed)):
        raise ConfigError(f"scene.parameters.key={key} changes no physics; {remedy}")
