"""Packages that not every user needs, asked for where they are used."""

import importlib.util

from nsf.errors import MissingExtraError


def require(module: str, what: str, extra: str) -> None:
    """Refuse to begin what a package is missing for.

    Args:
        module: of the package, as it is imported.
        what: the user asked for, as `hydra/launcher=slurm`.
        extra: of this package that brings it.

    Raises:
        MissingExtraError: it is not installed; names the command.
    """
    if importlib.util.find_spec(module) is None:
        raise MissingExtraError(f"{what} needs a package that is not installed; pip install 'nsf[{extra}]'")
