"""Problem parameters of a scene: the values that they replace (paper section 4.1)."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from nsf.errors import ConfigError
from nsf.scalars import is_finite
from nsf.scenes.paths import parts_of, value_at
from nsf.vectors import numbers

_NAME = re.compile(r"[A-Za-z]\w{0,39}", re.ASCII)
#: What a parameter may change.
_PHYSICS = re.compile(
    r"(material|transfer|gravity|inclination|colliders|walls|bodies\.[^.]+\.(density|velocity|weakness))\b"
)
#: The particles at rest, the grid and the steps, which all values of a parameter share.
_SHARED = re.compile(r"(dx|dt|steps|size|bodies\.[^.]+\.(shape|particles|particles_per_cell))\b")


@dataclass(frozen=True)
class Parameter:
    """One problem parameter μ of a scene (paper section 4.1).

    Attributes:
        key: of the value that it replaces, for example `material.friction_angle`,
            `scene.bodies.cube.velocity.0`.
        unit: for tables and charts; "" or "-" where it has none.
        range: smallest and largest value that a design may draw; None where `Values` lists them.
        log: whether a design draws evenly in its logarithm.

    Raises:
        ConfigError: the range is empty, reversed, or reaches zero on a logarithmic scale.
    """

    key: str
    unit: str
    range: Sequence[float] | None = None
    log: bool = False

    def __post_init__(self):
        if self.range is None:
            return
        low, high = numbers("range", self.range, self.unit, 2)
        if not low < high:
            raise ConfigError(f"range=[{low:g}, {high:g}] has nothing inside; give the smaller end first")
        if self.log and low <= 0.0:
            raise ConfigError(
                f"range=[{low:g}, {high:g}] reaches zero; a logarithmic scale begins above it: set log: false"
            )
        object.__setattr__(self, "range", (float(low), float(high)))

    @cached_property
    def path(self) -> tuple[str, ...]:
        """The key's parts from the scene on."""
        return parts_of(self.key)


def check_parameters(scene: Any, parameters: Mapping[str, Parameter]) -> None:
    """Refuse parameters that a scene cannot take.

    Raises:
        ConfigError: a name cannot be part of a file's, two parameters have one key, or a key names no number
            or something else than the physics.
    """
    where, keys = "scene.parameters", {}
    for name, parameter in parameters.items():
        if not _NAME.fullmatch(str(name)):
            raise ConfigError(
                f"{where} has the name {name!r}; give up to 40 letters, digits and _, a letter first"
            )
        if not isinstance(parameter, Parameter):
            raise ConfigError(f"{where}.{name}={parameter} must be a parameter, as Parameter('material.E')")
        if same := keys.get(parameter.path):
            raise ConfigError(f"{where}: {same} and {name} are both {parameter.key}; leave one out")
        keys[parameter.path] = name
        _check_key(scene, f"{where}.{name}.key", parameter)


def _check_key(scene: Any, where: str, parameter: Parameter) -> None:
    key, path = parameter.key, ".".join(parameter.path)
    remedy = "name a key of the material, the motion or the boundaries"
    if _SHARED.match(path):
        raise ConfigError(
            f"{where}={key} changes scene.{path}, but all values share the particles at rest, "
            f"the grid and the steps; {remedy}"
        )
    try:
        configured = value_at(scene, parameter.path)
    except KeyError as error:
        part, names = error.args
        raise ConfigError(
            f"{where}={key!r}: there is no {part!r}, but {', '.join(names) or 'nothing'}; {remedy}"
        ) from error
    if not is_finite(configured):
        raise ConfigError(f"{where}={key!r} names no key that holds a number; {remedy}")
    if not _PHYSICS.match(path):
        raise ConfigError(f"{where}={key} changes no physics; {remedy}")
