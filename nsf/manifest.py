"""The records of a run's folder, checked: its manifest, its configuration, and the sums of its files.

A folder may have been cut short, edited or made by someone else. Nothing here follows a link out of it, waits
for a pipe, reads more than a bound, or takes a value of another kind for what it should be.
"""

import copy
import hashlib
import os
import re
import reprlib
import stat
import time
from collections.abc import Callable, Mapping
from datetime import datetime
from pathlib import Path
from typing import Any

from nsf import schemas
from nsf.canonical import plain
from nsf.errors import NSFError, SchemaError, first_line
from nsf.schemas import Maybe, Number

MANIFEST = "manifest.json"
CONFIG = "config.yaml"
#: A folder's name that a stage, a scene or a hash may be.
NAME = re.compile(r"[A-Za-z0-9][\w.+-]*", re.ASCII)
#: Stages of `nsf run` that leave runs, in order, and all that do.
CHAIN = ("simulate", "train", "encode", "teach", "deploy", "evaluate")
STAGES = (*CHAIN, "superresolve")
STATUSES = ("running", "complete", "failed", "interrupted")

_RUN = re.compile(rf"{NAME.pattern}/{NAME.pattern}/{NAME.pattern}", re.ASCII)
_MOST_BYTES = {MANIFEST: 2**21, CONFIG: 2**18}  # a configuration takes milliseconds a KiB
_DEEPEST = 32  # lists and mappings inside each other
#: A file changed later than this [s] ago may change once more without another time stamp.
_SETTLED = 2.0

_OUTPUT = {
    "path": re.compile(r"(?!\.{1,2}(/|$))[^/]+(/(?!\.{1,2}(/|$))[^/]+)*"),  # below the folder
    "bytes": Number(0, whole=True),
    "sha256": re.compile("[0-9a-f]{64}"),
}
_SCHEMA = {
    Maybe("format"): int,
    Maybe("stage"): str,
    Maybe("scene"): str,
    Maybe("hash"): str,
    Maybe("parents"): [_RUN],
    Maybe("commit"): (str, None),
    Maybe("dirty"): (bool, None),
    Maybe("versions"): {...: (str, None)},  # a package may be there without its metadata
    Maybe("device"): str,
    Maybe("seed"): (int, None),
    Maybe("precision"): (str, None),
    Maybe("created"): str,
    "status": re.compile("|".join(STATUSES)),
    Maybe("error"): str,
    Maybe("warnings"): [str],
    Maybe("seconds"): Number(0),
    Maybe("metrics"): dict,
    Maybe("outputs"): [_OUTPUT],
}
#: Keys that the manifest of a complete run has.
_OF_COMPLETE = dict.fromkeys(("created", "seconds", "metrics", "outputs"), (str, float, dict, list))
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
    return once(_sha256, path, path.stat())


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
    """The result of `read` on a file; None where there is none."""
    try:
        return copy.deepcopy(once(read, path, _regular(path)))
    except (FileNotFoundError, NotADirectoryError):
        return None
    except OSError as error:
        raise SchemaError(f"{path.name} cannot be read: {error.strerror}") from error


def once(read: Callable[[Path], Any], path: Path, found: os.stat_result) -> Any:
    """The result of `read` on a file, read once a process for as long as the file stays the same."""
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


def _json(path: Path) -> dict[str, Any]:
    manifest = schemas.read(path, _SCHEMA, _MOST_BYTES[MANIFEST])
    try:
        if manifest["status"] == "complete":
            schemas.check(manifest, _OF_COMPLETE)
        if "created" in manifest:
            datetime.fromisoformat(manifest["created"]).astimezone()
        if odd := next((o for o in manifest.get("outputs", ()) if not o["path"].isprintable()), None):
            raise SchemaError(f"outputs has the path {_shown(odd['path'])}")
    except SchemaError as error:
        raise SchemaError(f"{path.name}: {error}") from error
    except (ValueError, OverflowError, OSError) as error:
        raise SchemaError(f"{path.name}: created={_shown(manifest['created'])} is no time") from error
    return manifest


def _yaml(path: Path) -> dict[str, Any]:
    import yaml

    try:
        text = schemas.read_text(path, _MOST_BYTES[CONFIG])
        depth = 0
        for event in yaml.parse(text, Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader)):
            depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
            # An alias stands for a copy, and a few of them for billions; nesting takes its square in time.
            if isinstance(event, yaml.AliasEvent) or depth > _DEEPEST:
                raise SchemaError(f"{path.name} has an alias (*), or more than {_DEEPEST} levels")
        config = yaml.load(text, Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader))
        if not isinstance(config, dict):
            raise SchemaError(f"{path.name} holds {_shown(config)}, not keys with values")
        config = plain(config)
    except (SchemaError, OSError):
        raise
    except Exception as error:  # whatever the parser makes of a text that is no configuration
        told = str(error) if isinstance(error, NSFError) else first_line(error)
        raise SchemaError(f"{path.name} is no configuration: {told}") from error
    if schemas.is_strange(config):
        raise SchemaError(f"{path.name} holds a value that no configuration has")
    return config


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _shown(value: Any) -> str:
    return reprlib.repr(value)
