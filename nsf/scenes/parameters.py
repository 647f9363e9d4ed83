"""Problem parameters of a scene: the keys that they replace (paper section 4.1)."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from nsf import config as configuration
from nsf.config.resolvers import following, leaves
from nsf.config.targets import filled
from nsf.errors import ConfigError
from nsf.vectors import numbers

_NAME = re.compile(r"[A-Za-z]\w{0,39}", re.ASCII)
#: Keys that the physics is read from; a scene may have others, which these refer to.
_PHYSICS = re.compile(r"(material|transfer|scene\.(gravity|bodies|colliders|walls))\.")
#: Keys of the particles at rest, the grid and the steps, which all values of a parameter share.
_SHARED = re.compile(r"scene\.(dx|dt|steps|size|bodies\.[^.]+\.(shape|particles|particles_per_cell))(\.|$)")


@dataclass(frozen=True)
class Parameter:
    """One problem parameter μ of a scene (paper section 4.1).

    Attributes:
        key: configuration key that it replaces, for example `material.friction_angle`.
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


def parameters_of(nodes: Mapping[str, Any]) -> dict[str, Parameter]:
    """The parameters of `scene.parameters`, by name; null in place of one leaves out that of a scene below.

    Raises:
        ConfigError: there is none; a name cannot be part of a file's; two have one key; or one is refused.
    """
    where, found = "scene.parameters", {}
    for name, node in ((name, node) for name, node in nodes.items() if node is not None):
        if not isinstance(node, Mapping):
            raise ConfigError(
                f"{where}.{name}={node} must map keys to values, as {{key: material.E, unit: Pa}}"
            )
        if not _NAME.fullmatch(str(name)):
            raise ConfigError(
                f"{where} has the name {name!r}; give up to 40 letters, digits and _, a letter first"
            )
        found[name] = filled(Parameter, node, f"{where}.{name}")
        same = next((other for other in found if other != name and found[other].key == node["key"]), None)
        if same:
            raise ConfigError(f"{where}: {same} and {name} are both {node['key']}; leave one out")
    if not found:
        raise ConfigError(f"{where}={dict(nodes)} leaves nothing to vary; give a name with its key and unit")
    return found


def check_key(name: str, key: str, values: Sequence[float], config: DictConfig, template: DictConfig) -> None:
    """Refuse a problem parameter that holds no number, or changes something else than the physics.

    Args:
        name: of the parameter.
        key: of the configuration.
        values: that it takes.
        config: the configuration, resolved.
        template: the same with its interpolations, as others may refer to the key.

    Raises:
        ConfigError: says what the key changes.
    """
    where, remedy = f"scene.parameters.{name}.key", "name a key of the material, the motion or the boundaries"
    try:
        own = OmegaConf.select(config, key) if key else None
    except OmegaConfBaseException:  # it is no key, as ../name
        own = None
    if not isinstance(own, int | float) or isinstance(own, bool):
        raise ConfigError(f"{where}={key!r} names no key that holds a number; {remedy}")
    value = float(next(value for value in (*values, own + 1.0) if value != own))
    paths = following(template, key)
    other = configuration.resolve_again(template.copy(), {key: value}, config.copy(), paths)
    before, after = (dict(leaves(OmegaConf.to_container(c))) for c in (config, other))
    changed = [".".join(path) for path, value in after.items() if before.get(path) != value]
    if shared := [name for name in changed if _SHARED.match(name)]:
        raise ConfigError(
            f"{where}={key} changes {shared[0]}, but all values share the particles at rest, "
            f"the grid and the steps; {remedy}"
        )
    if not any(map(_PHYSICS.match, changed)):
        raise ConfigError(f"{where}={key} changes no physics; {remedy}")
