"""What a run's folder says of itself, checked: its manifest, its configuration, and the sums of its files.

A folder may have been cut short, edited or made by someone else. Nothing here follows a link out of it, waits
for a pipe, reads more than a bound, or takes a value of another kind for what it should be.
"""

import copy
import hashlib
import json
import math
import os
import re
import reprlib
import stat
import time
from collections.abc import Callable, Mapping
from datetime import datetime
from pathlib import Path
from typing import Any

from nsf.errors import NSFError, SchemaError, first_line
from nsf.runs.canonical import plain

MANIFEST = "manifest.json"
CONFIG = "config.yaml"
#: A folder's name that a stage, a scene or a hash may be.
NAME = re.compile(r"[A-Za-z0-9][\w.+-]*", re.ASCII)
STATUSES = ("running", "complete", "failed", "interrupted")

_RUN = re.compile(rf"{NAME.pattern}/{NAME.pattern}/{NAME.pattern}", re.ASCII)
_SUM = re.compile("[0-9a-f]{64}")
_MOST_BYTES = {MANIFEST: 2**21, CONFIG: 2**18}  # a configuration takes milliseconds a KiB
_DEEPEST = 32  # lists and mappings inside each other
_WIDEST = 2**63  # whole numbers below it
#: A file changed later than this [s] ago may change once more without another time stamp.
_SETTLED = 2.0

_TEXT, _WHOLE, _NONE = (str,), (int,), (type(None),)
_KINDS: dict[str, tuple[type, ...]] = {
    "format": _WHOLE,
    "stage": _TEXT,
    "scene": _TEXT,
    "hash": _TEXT,
    "parents": (list,),
    "commit": _TEXT + _NONE,
    "dirty": (bool, *_NONE),
    "versions": (dict,),
    "device": _TEXT,
    "seed": _WHOLE + _NONE,
    "precision": _TEXT + _NONE,
    "created": _TEXT,
    "status": _TEXT,
    "error": _TEXT,
    "seconds": (int, float),
    "metrics": (dict,),
    "outputs": (list,),
}  # fmt: skip
_KNOWN: dict[tuple, Any] = {}


def read_manifest(folder: Path) -> dict[str, Any]:
    """The manifest of a run's folder; empty where there is none.

    Raises:
        SchemaError: it is no manifest; says why, without the folder.
    """
    return _read(_json, folder / MANIFEST) or {}


def read_config(folder: Path) -> dict[str, Any]:
    """The resolved configuration of a run's folder, in plain containers; nothing in it is resolved again.

    Raises:
        SchemaError: it is missing, or no configuration; says why, without the folder.
    """
    if (found := _read(_yaml, folder / CONFIG)) is None:
        raise SchemaError(f"{CONFIG} is missing")
    return found


def digest(path: Path) -> str:
    """sha256 of a file in hex, found once a process for as long as the file stays the same.

    A processor with instructions for it takes about a second a GB.
    """
    return _once(_sha256, path, path.stat())


def altered(folder: Path, output: Mapping[str, Any], sums: bool = True) -> str | None:
    """How a file of a run differs from what the manifest records of it; None where it does not.

    Args:
        folder: of the run.
        output: the manifest's entry.
        sums: compare the sha256 too, for which the file is read.
    """
    path = folder / output["path"]
    try:
        found = _regular(path, within=folder)
        if found.st_size != output["bytes"]:
            return f"has {found.st_size} bytes, where its manifest records {output['bytes']}"
        if sums and (sha256 := digest(path)) != output["sha256"]:
            return f"has sha256 {sha256[:12]}, where its manifest records {output['sha256'][:12]}"
    except FileNotFoundError:
        return "is missing"
    except (OSError, SchemaError) as error:
        return f"cannot be read ({error})"
    return None


def verified(path: str | Path) -> Path:
    """The path of a file that is about to be read, once it is sure to be what its run left.

    Where a manifest beside it records the file, size and sha256 must be the recorded ones. A file without
    one, which someone keeps elsewhere, must be a regular file, and is what it is.

    Raises:
        FileNotFoundError: there is no such file.
        SchemaError: it was changed after its run, or is no regular file.
    """
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(path)
    try:
        manifest = read_manifest(path.parent)
    except SchemaError as error:
        raise SchemaError(f"{path}: the run it is of is broken ({error}); make it again") from error
    own = next((output for output in manifest.get("outputs", ()) if output["path"] == path.name), None)
    if own is None and not path.is_file():
        raise SchemaError(f"{path} is no regular file; give a file")
    if own is not None and (told := altered(path.parent, own)):
        raise SchemaError(
            f"{path} {told}: it was changed after the run; delete the run's folder and run "
            f"`nsf {manifest.get('stage', 'run')}` again"
        )
    return path


def _read(read: Callable[[Path], dict[str, Any]], path: Path) -> dict[str, Any] | None:
    """What `read` makes of a file, for the caller to keep; None where there is none."""
    try:
        return copy.deepcopy(_once(read, path, _regular(path)))
    except (FileNotFoundError, NotADirectoryError):
        return None
    except OSError as error:
        raise SchemaError(f"{path.name} cannot be read: {error.strerror}") from error


def _once(read: Callable[[Path], Any], path: Path, found: os.stat_result) -> Any:
    """What `read` makes of a file, once a process for as long as the file stays the same."""
    stamp = (found.st_dev, found.st_ino, found.st_size, found.st_mtime_ns, found.st_ctime_ns)
    key = (read, *stamp)
    if key in _KNOWN:
        return _KNOWN[key]
    value = read(path)
    if time.time() - found.st_ctime > _SETTLED:
        _KNOWN[key] = value
    return value


def _regular(path: Path, within: Path | None = None) -> os.stat_result:
    """Raises SchemaError where a path, or one on its way below `within`, is a link, a pipe or a folder."""
    found = path.lstat()
    if not stat.S_ISREG(found.st_mode):
        raise SchemaError(f"{path.name} is no regular file")
    if within is not None and path.resolve() != within.resolve() / path.relative_to(within):
        raise SchemaError(f"{path.name} is reached by a link")
    return found


def _text(path: Path) -> str:
    most = _MOST_BYTES[path.name]
    with path.open("rb") as file:
        content = file.read(most + 1)
    if len(content) > most:
        raise SchemaError(f"{path.name} has more than {most:,} bytes")
    try:
        return content.decode()
    except UnicodeDecodeError as error:
        raise SchemaError(f"{path.name} is not UTF-8") from error


def _json(path: Path) -> dict[str, Any]:
    try:
        manifest = json.loads(_text(path), parse_constant=_not_json)
    except (ValueError, RecursionError) as error:
        raise SchemaError(f"{path.name} is no JSON: {first_line(error)}") from error
    if not isinstance(manifest, dict):
        raise SchemaError(f"{path.name} holds {_shown(manifest)}, not keys with values")
    if (told := _odd_manifest(manifest)) is not None:
        raise SchemaError(f"{path.name}: {told}")
    return manifest


def _yaml(path: Path) -> dict[str, Any]:
    import yaml
    from omegaconf import OmegaConf  # 0.2 s that `nsf --help` need not pay

    try:
        text = _text(path)
        depth = 0
        for event in yaml.parse(text, Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader)):
            depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
            # An alias stands for a copy, and a few of them for billions; nesting takes its square in time.
            if isinstance(event, yaml.AliasEvent) or depth > _DEEPEST:
                raise SchemaError(f"{path.name} has an alias (*), or more than {_DEEPEST} levels")
        config = OmegaConf.to_container(OmegaConf.create(text))
        if not isinstance(config, dict):
            raise SchemaError(f"{path.name} holds {_shown(config)}, not keys with values")
        config = plain(config)
    except (SchemaError, OSError):
        raise
    except Exception as error:  # whatever the parser makes of a text that is no configuration
        told = str(error) if isinstance(error, NSFError) else first_line(error)
        raise SchemaError(f"{path.name} is no configuration: {told}") from error
    if _strange(config):
        raise SchemaError(f"{path.name} holds a value that no configuration has")
    return config


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _not_json(name: str) -> None:
    raise ValueError(f"{name} is no number of JSON")


def _odd_manifest(manifest: dict[str, Any]) -> str | None:
    """What is wrong with the values of a manifest; None where each is of its kind."""
    for key, kinds in _KINDS.items():
        if key in manifest and type(manifest[key]) not in kinds:
            wanted = " or ".join("null" if kind is type(None) else kind.__name__ for kind in kinds)
            return f"{key}={_shown(manifest[key])} must be {wanted}"
    if manifest.get("status") not in STATUSES:
        return f"status={_shown(manifest.get('status'))} must be one of {', '.join(STATUSES)}"
    if _strange(manifest):
        return f"it holds a number that is not finite, broken text, or more than {_DEEPEST} levels"
    for parent in manifest.get("parents", ()):
        if not (isinstance(parent, str) and _RUN.fullmatch(parent)):
            return f"parents holds {_shown(parent)}, which is no stage/scene/hash"
    for output in manifest.get("outputs", ()):
        if not _is_output(output):
            return f"outputs holds {_shown(output)}, which is no path, bytes and sha256 of a file"
    try:
        if "created" in manifest:
            datetime.fromisoformat(manifest["created"]).astimezone()
    except (ValueError, OverflowError, OSError):
        return f"created={_shown(manifest['created'])} is no time"
    return None


def _is_output(output: Any) -> bool:
    if not isinstance(output, dict):
        return False
    path, size, sha256 = (output.get(key) for key in ("path", "bytes", "sha256"))
    if not (isinstance(path, str) and type(size) is int and isinstance(sha256, str)):
        return False
    inside = path.isprintable() and not {"", ".", ".."} & set(path.split("/"))
    return inside and size >= 0 and _SUM.fullmatch(sha256) is not None


def _strange(value: Any, depth: int = 0) -> bool:
    """Whether a tree is too deep for its readers, or a leaf cannot be shown or written."""
    if isinstance(value, dict | list):
        children = [*value, *value.values()] if isinstance(value, dict) else value
        return depth == _DEEPEST or any(_strange(child, depth + 1) for child in children)
    if isinstance(value, str):
        return not value.isascii() and any("\ud800" <= c <= "\udfff" for c in value)
    if isinstance(value, float):
        return not math.isfinite(value)
    return isinstance(value, int) and abs(value) >= _WIDEST


def _shown(value: Any) -> str:
    return reprlib.repr(value)
