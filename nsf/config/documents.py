"""Yaml files that someone else may have written: read as text that a parser can take."""

import re
from collections.abc import Iterable
from functools import lru_cache
from pathlib import Path

import yaml

from nsf.errors import ConfigError

_LONGEST = 2**20  # bytes; the longest file of conf/ and experiments/ has some thousand
_MOST = 100_000  # values, each as often as it is repeated through an alias
LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


def text_of(path: Path) -> str:
    """The text of a yaml file, once it is sure that it can be parsed, and how much it stands for.

    Raises:
        ConfigError: it cannot be read, is too long, is no yaml, holds control characters or another encoding
            than UTF-8, is nested too deeply, or repeats itself too often; names file and line.
    """
    try:
        status = path.stat()
    except OSError as error:
        raise ConfigError(f"{path} cannot be read: {error.strerror}") from error
    return _text_of(path, status.st_mtime_ns, status.st_size)


def check_sizes(paths: Iterable[Path]) -> tuple[tuple[Path, int, int], ...]:
    """Refuse yaml files that no parser would come to the end of.

    Returns:
        path, time of change [ns] and size [bytes] of each.

    Raises:
        ConfigError: as for `text_of`, of files that are long or have aliases.
    """
    stats = [(path, path.stat()) for path in paths]
    files = tuple((path, status.st_mtime_ns, status.st_size) for path, status in stats)
    _check_sizes(files)
    return files


@lru_cache(maxsize=8)
def _check_sizes(files: tuple[tuple[Path, int, int], ...]) -> None:
    for path, _, size in files:
        if size > _LONGEST or {b"&", b"*"} <= {*re.findall(rb"[&*]", path.read_bytes())}:
            text_of(path)


@lru_cache(maxsize=256)
def _text_of(path: Path, _changed: int, size: int) -> str:
    if size > _LONGEST:
        raise ConfigError(f"{path} has {size} bytes, more than the {_LONGEST} of a configuration; shorten it")
    try:
        text = path.read_bytes().decode("utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path} cannot be read: {error}; save it as UTF-8") from error
    if control := re.search(r"[\x00-\x08\x0b-\x1f\x7f]", text.replace("\r\n", "\n")):
        line = text.count("\n", 0, control.start()) + 1
        raise ConfigError(f"{path}, line {line}: control character {control[0]!r}; delete it")
    try:
        node = yaml.compose(text, LOADER)
        if _repeated(node, {}) > _MOST:
            raise ConfigError(f"{path} has more than {_MOST} values, as aliases repeat them; write them out")
    except RecursionError as error:
        raise ConfigError(f"{path} is nested too deeply, or holds itself; flatten it") from error
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        line = f", line {mark.line + 1}" if mark else ""
        raise ConfigError(f"{path}{line}: {getattr(error, 'problem', error)}; correct the yaml") from error
    return text


def _repeated(node: yaml.Node | None, counts: dict[int, int]) -> int:
    """How many values a node stands for, with those of aliases each time."""
    if not isinstance(node, yaml.CollectionNode):
        return 1
    if id(node) not in counts:
        mapping = isinstance(node, yaml.MappingNode)
        children = [one for pair in node.value for one in pair] if mapping else node.value
        counts[id(node)] = 1 + sum(_repeated(child, counts) for child in children)
    return counts[id(node)]
