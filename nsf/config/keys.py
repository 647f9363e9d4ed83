"""Keys of a composed configuration: read, replaced, or named where one is missing."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import ConfigAttributeError, ConfigKeyError, OmegaConfBaseException

from nsf.errors import ConfigError, first_line


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
    node = OmegaConf.select(config, key)
    if not isinstance(node, DictConfig):
        raise ConfigError(f"{key}={'null' if node is None else node} must map keys to values")
    return node


def replaced(config: DictConfig, values: Mapping[str, Any]) -> DictConfig:
    """A copy with other values of some keys; a key that refers to a replaced one follows.

    Args:
        config: composed, its interpolations kept.
        values: by dotted key.

    Raises:
        ConfigError: a key holds others, or a value on the way to it.
    """
    config = config.copy()
    for key, value in values.items():
        try:
            if isinstance(node := OmegaConf.select(config, key), DictConfig):
                names = [f"{key}.{name}" for name in node if name != "_target_"]
                raise ConfigError(f"several keys in {key!r}; did you mean {' or '.join(names[:3])}?")
            OmegaConf.update(config, key, value)
        except OmegaConfBaseException as error:
            raise ConfigError(f"{key} cannot be set: {first_line(error)}; give a dotted key") from error
    return config
