"""Configurations composed by Hydra from the groups of `conf/`, resolved and checked."""

import os
import pickle
import re
import typing
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from functools import cache, lru_cache
from pathlib import Path

from hydra import compose, version
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra._internal.hydra import Hydra
from hydra._internal.utils import create_config_search_path
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf, open_dict, read_write
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from nsf import paths
from nsf.config import targets
from nsf.config.documents import check_sizes
from nsf.config.removed import refuse_keys
from nsf.config.resolvers import resolved
from nsf.config.schema import refuse_unread
from nsf.errors import ConfigError
from nsf.paths import REMEDY, files, groups, user_folders

_Sizes = tuple[tuple[Path, int, int], ...]  # of files: their times and bytes, by which a change is seen
#: Raised by Hydra and the yaml parser on files that are no configuration, beside their own errors.
OF_BROKEN_FILES = (
    YAMLError,
    ValueError,
    RecursionError,
    AttributeError,
    TypeError,
    LookupError,
    AssertionError,
)


def composed(config_name: str, overrides: Sequence[str]) -> DictConfig:
    """The configuration that Hydra composes of overrides and files, unchecked; it takes new keys."""
    return pickle.loads(_composed(config_name, tuple(overrides), check_sizes(files())))


@lru_cache(maxsize=64)
def _composed(config_name: str, overrides: tuple[str, ...], _sizes: _Sizes) -> bytes:
    """The same pickled: jobs ask for the same again."""
    return pickle.dumps(unlocked(config_name, overrides))


def unlocked(config_name: str, overrides: Sequence[str]) -> DictConfig:
    """The configuration of `composed`, composed anew."""
    config = with_values(config_name, overrides, check_sizes(files()))
    if config is None or "hydra" in config:
        config = _apart(_with_hydra(config_name, overrides))
    OmegaConf.set_readonly(config, False)
    OmegaConf.set_struct(config, False)
    return config


def _apart(config: DictConfig) -> DictConfig:
    """A configuration without Hydra's own part, which must be as it is by default."""
    hydra = _of_hydra(config)
    if hydra != _default_hydra():
        changed = [f"hydra.{key}" for key, value in hydra.items() if value != _default_hydra().get(key)]
        if "hydra.searchpath" in changed:
            raise ConfigError(f"hydra.searchpath is refused; {REMEDY}")
        raise ConfigError(
            f"the configuration sets {', '.join(changed)}, by which Hydra could be made to run code; "
            "leave it out: only the command line says how jobs are launched"
        )
    with open_dict(config), read_write(config):
        del config["hydra"]
    return config


@contextmanager
def initialized(job_name: str = "app") -> Iterator[None]:
    """Hydra over `conf/` and the user's folders before it, while a block works, anew."""
    GlobalHydra.instance().clear()
    version.setbase("1.3")
    search_path = create_config_search_path(str(paths.CONF))
    for folder in user_folders():
        search_path.prepend("user", str(folder), anchor="main")
    Hydra.create_main_hydra2(job_name, search_path)
    try:
        yield
    finally:
        GlobalHydra.instance().clear()


def _with_hydra(config_name: str | None, overrides: Sequence[str]) -> DictConfig:
    with initialized():
        return compose(config_name, overrides=list(overrides), return_hydra_config=True)


def with_values(config_name: str, overrides: Sequence[str], sizes: _Sizes) -> DictConfig | None:
    """As by `_with_hydra` in a quarter of the time: values set on options that many jobs share.

    None where Hydra refuses the values, so that it says of all overrides together what is wrong.

    Raises:
        HydraException: a key is missing, of which it would say the same.
    """
    names = groups()
    options = tuple(o for o in overrides if _of_group(o, names))
    config = pickle.loads(_of_groups(config_name, options, sizes))
    try:
        values = [_parsed(override) for override in overrides if override not in options]
        if not any(value.is_sweep_override() for value in values):
            ConfigLoaderImpl._apply_overrides_to_config(values, config)
            return config
    except (HydraException, OmegaConfBaseException, *OF_BROKEN_FILES) as error:
        if isinstance(error, HydraException) and missing_key(error):
            raise
    return None


def missing_key(error: Exception) -> str | None:
    """The key of an override that Hydra does not take, as the configuration has none like it."""
    match = re.search(r"Could not override '([^']+)'", str(error))
    return match[1] if match else None


@lru_cache(maxsize=1024)
def _parsed(override: str) -> Override:
    """An override as Hydra reads it: jobs share most of theirs, and each takes a millisecond."""
    return OverridesParser.create().parse_override(override)


def _of_group(override: str, names: Collection[str]) -> bool:
    """Whether an override is not of a value alone: it chooses an option, or is about Hydra."""
    key = override.lstrip("+~").partition("=")[0]
    return key in names or "@" in key or "/" in key or of_launcher(override)


@lru_cache(maxsize=256)
def _of_groups(config_name: str, options: tuple[str, ...], _sizes: _Sizes) -> bytes:
    return pickle.dumps(_apart(_with_hydra(config_name, options)))


def _of_hydra(config: DictConfig) -> dict[str, typing.Any]:
    """Hydra's own part of a configuration, without what it tells of the overrides."""
    hydra = OmegaConf.to_container(config.hydra)
    hydra["job"] = {k: v for k, v in hydra["job"].items() if k not in ("override_dirname", "config_name")}
    return {k: v for k, v in hydra.items() if k not in ("overrides", "runtime")}


@cache
def _default_hydra() -> dict[str, typing.Any]:
    return _of_hydra(_with_hydra(None, ()))


def checked(config: DictConfig) -> DictConfig:
    """The configuration with its interpolations, once it is sure that all of them resolve.

    Raises:
        ConfigError: see `load`.
    """
    check(config)
    return pickle.loads(pickle.dumps(config))


def resolve(config: DictConfig) -> DictConfig:
    """Replace every interpolation by its value and check targets and missing values.

    Raises:
        ConfigError: see `load`.
    """
    return pickle.loads(_node(check(config)))


def check(config: DictConfig) -> bytes:
    """The pickled tree of a configuration whose interpolations are resolved, once that is checked."""
    try:
        return _resolved(Tree(config), os.environ.get("NSF_REPORTS"))
    except RecursionError as error:
        raise ConfigError("the configuration is nested too deeply; flatten it") from error


class Tree:
    """A configuration that a cache knows by its content."""

    def __init__(self, config: DictConfig):
        self.config, self.raw = config, OmegaConf.to_container(config)
        self._content = pickle.dumps(self.raw)

    def __hash__(self) -> int:
        return hash(self._content)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Tree) and self._content == other._content


@lru_cache(maxsize=64)
def _node(tree: bytes) -> bytes:
    """A pickled tree as a pickled configuration: stages ask for the same again."""
    return pickle.dumps(OmegaConf.create(pickle.loads(tree)))


@lru_cache(maxsize=64)
def _resolved(tree: Tree, _reports: str | None) -> bytes:
    """A pickled tree resolved and checked: jobs ask for the same again. A value may name NSF_REPORTS."""
    plain = resolved(tree.config)
    refuse_keys(plain)
    targets.check(plain)
    refuse_unread(tree.raw, plain)
    return pickle.dumps(plain)


def of_launcher(override: str) -> bool:
    """Whether an override is about how jobs are launched, as `hydra/launcher=slurm`, and not about a job."""
    return override.lstrip("+~").startswith(("hydra/", "hydra."))


def names_scene(override: str) -> bool:
    """Whether an override chooses the scene."""
    return override.lstrip("+").startswith(("scene=", "scene@"))
