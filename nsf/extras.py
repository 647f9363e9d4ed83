"""Libraries that only some users need: imported when they are used, or named with the remedy."""

import importlib
from types import ModuleType

from nsf.errors import MissingExtraError


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
