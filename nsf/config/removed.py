"""Keys and options that an earlier version had, which are refused by naming their replacement."""

from collections.abc import Iterable, Mapping
from typing import Any

from nsf.errors import ConfigError

#: A dotted key, or `key=option`, and the remedy.
REMOVED = {
    "deploy.tolerance": "deploy.on_distrust=projected hands a run by operators on where it is not believed",
    "engine=closed": "choose engine=operators, or engine=auto",
    "field=joint": "use field=basis",
    "sampler=greedy": "use sampler=qdeim or sampler=cubature",
    "trainer.budget_minutes": "set trainer.steps; a training's log says how many it takes a second",
    "trainer.devices": "a manifold trains on one device; hydra/launcher=joblib spreads jobs over GPUs",
}


def refuse_overrides(overrides: Iterable[str]) -> None:
    """Refuse an override of a removed key, or that chooses a removed option.

    Raises:
        ConfigError: names the replacement.
    """
    for override in overrides:
        key, _, value = override.lstrip("+~").partition("=")
        parts = key.split(".")
        for candidate in (f"{key}={value}", *(".".join(parts[:n]) for n in range(len(parts), 0, -1))):
            _refuse(candidate)


def refuse_keys(plain: Mapping[str, Any]) -> None:
    """Refuse a configuration that has a removed key.

    Args:
        plain: containers, as of a file.

    Raises:
        ConfigError: names the replacement.
    """
    for key in REMOVED:
        node: Any = plain
        *parents, last = key.split(".")
        for parent in parents:
            node = node.get(parent) if isinstance(node, Mapping) else None
        if isinstance(node, Mapping) and last in node:
            _refuse(key)


def _refuse(name: str) -> None:
    if name in REMOVED:
        raise ConfigError(f"{name} was removed; {REMOVED[name]}")
