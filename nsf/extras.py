"""Imports at the moment of use: of a package's own names, and of libraries that only some users need."""

import ast
import importlib
import sys
import time
from collections.abc import Callable
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

from nsf.errors import MissingExtraError

#: When this process began to import nsf, by `time.monotonic` [s].
STARTED = time.monotonic()
#: Holds it where the process is a command of the command line, which has no idle time before its work.
COMMAND: list[float] = []


def on_first_use(package: str) -> Callable[[str], Any]:
    """The `__getattr__` of a package whose names are imported when they are first asked for.

    The names are those that its `__init__.py` imports under `if TYPE_CHECKING`, where type checkers and
    readers find them; they stand nowhere else.

    Args:
        package: its `__name__`.
    """

    def find(name: str) -> Any:
        home = _homes(sys.modules[package].__file__).get(name)
        if home is None:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return getattr(importlib.import_module(home), name)

    return find


@cache
def _homes(file: str) -> dict[str, str]:
    """Modules from which a file imports names under `if TYPE_CHECKING`, by name."""
    return {
        alias.name: node.module
        for block in ast.parse(Path(file).read_text(encoding="utf-8")).body
        if isinstance(block, ast.If) and getattr(block.test, "id", None) == "TYPE_CHECKING"
        for node in block.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }


def optional(module: str, extra: str) -> ModuleType:
    """Import a module of an extra.

    Args:
        module: dotted name, such as `pxr.Usd`.
        extra: of this package's `pyproject.toml`, such as `export`.

    Raises:
        MissingExtraError: it cannot be imported; names the command that installs it.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise MissingExtraError(
            f"{module} cannot be imported ({error}); pip install 'nsf[{extra}]'"
        ) from error
