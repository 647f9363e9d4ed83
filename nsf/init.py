"""`nsf init`: a small project of the user, with a law, a scene, an experiment and a test."""

import importlib.util
import keyword
import os
import re
import shutil
import tempfile
from pathlib import Path

from nsf.errors import ConfigError, StorageError

_TEMPLATE = Path(__file__).parent / "template"
_NAME = "PROJECT"  # which the project's name takes the place of, in texts and in paths


def write_project(folder: Path) -> str:
    """Write a project into a folder that is not there yet, or is empty.

    Returns:
        The name of its package, which is the folder's with `_` for what a name cannot have.

    Raises:
        ConfigError: the folder has files, or no package can have its name, or an installed one has.
        StorageError: it cannot be written.
    """
    folder = Path(os.path.abspath(folder.expanduser()))
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise ConfigError(f"{folder} is there already; name a folder that is new or empty")
    name = re.sub(r"\W", "_", folder.name.lower(), flags=re.ASCII).rstrip("_")
    if not re.match("[a-z]", name) or keyword.iskeyword(name):
        raise ConfigError(f"{folder.name!r} cannot name a package; begin the folder's name with a letter")
    if importlib.util.find_spec(name) is not None:
        raise ConfigError(f"{name!r} is the name of a package that is installed; name the folder otherwise")
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder.parent) as partial:
            whole = Path(partial) / "project"
            for path in sorted(_TEMPLATE.rglob("*")):
                if path.is_file() and "__pycache__" not in path.parts:
                    _write(path, whole / str(path.relative_to(_TEMPLATE)).replace(_NAME, name), name)
            shutil.copymode(folder if folder.exists() else folder.parent, whole)
            whole.rename(folder)
    except OSError as error:
        raise StorageError(f"{folder} cannot be written: {error.strerror}; name another folder") from error
    return name


def _write(source: Path, path: Path, name: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(source.read_text(encoding="utf-8").replace(_NAME, name), encoding="utf-8")
