"""Keys of a composed configuration: found, replaced, or named where one is missing."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import ConfigAttributeError, ConfigKeyError

from nsf.config import targets
from nsf.errors import ConfigError, unknown


@contextmanager
def naming_the_missing() -> Iterator[None]:
    """Say which key is missing that the block reads from a configuration.

    Raises:
        ConfigError: one is missing.
    """
    try:
        yield
    except (ConfigAttributeError, ConfigKeyError) as error:
        raise ConfigError(f"{error.full_key} is missing from the configuration; give it a value") from error


def section(config: DictConfig, key: str) -> DictConfig:
    """The keys below a key.

    Raises:
        ConfigError: it is missing, or holds something else.
    """
    found = OmegaConf.select(config, key)
    if not isinstance(found, DictConfig):
        raise ConfigError(f"{key}={'null' if found is None else found} must map keys to values")
    return found


def replaced(config: DictConfig, values: Mapping[str, Any], known: Sequence[str]) -> DictConfig:
    """A copy with other values of some keys; a key that refers to a replaced one follows.

    Args:
        config: composed, its interpolations kept.
        values: by dotted key.
        known: keys that may be replaced, as of `leaves`.

    Raises:
        ConfigError: an unknown key, with the nearest known one, or one that holds others.
    """
    config = config.copy()
    for key, value in values.items():
        if key not in known:
            if inner := [k for k in known if k.startswith(f"{key}.")]:
                raise ConfigError(f"several keys in {key!r}; did you mean {' or '.join(inner[:3])}?")
            raise ConfigError(unknown(key, known, "give a dotted key, as scene.gravity"))
        OmegaConf.update(config, key, value)
    return config


def leaves(node, prefix: str = "") -> list[str]:
    """Dotted keys of a plain tree that hold values, and those that a `_target_` has a default for."""
    if not isinstance(node, dict):
        return [prefix]
    path = tuple(prefix.split("."))
    unset = targets.keys_of(node["_target_"], path) if "_target_" in node else []
    return [
        key
        for name, child in (dict.fromkeys(unset) | node).items()
        if not name.startswith("_")
        for key in leaves(child, f"{prefix}.{name}" if prefix else name)
    ]
