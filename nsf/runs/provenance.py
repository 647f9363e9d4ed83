"""The code and the versions that produce a result."""

import importlib.metadata
import os
import platform
import subprocess
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

_DISTRIBUTIONS = {
    "nsf": "nsf",
    "warp": "warp-lang",
    "torch": "torch",
    "lightning": "pytorch-lightning",
    "hydra": "hydra-core",
    "numpy": "numpy",
}


@cache
def provenance() -> dict[str, Any]:
    """The code's commit, whether the package differs from it (`dirty`), and the versions in use.

    Where the package is not in a git checkout, as in a container, the environment
    variable NSF_COMMIT may name the commit. `dirty` is then None.
    """
    file = Path(__file__)
    here = file.parents[1]
    # Another project's checkout may hold an installed package; its git does not track the package.
    tracked = _git(file.parent, "ls-files", "--error-unmatch", file.name)
    commit = _git(here, "rev-parse", "HEAD") if tracked else os.environ.get("NSF_COMMIT")
    changes = _git(here, "status", "--porcelain", "--", ".") if tracked else None
    return {
        "commit": commit,
        "dirty": None if changes is None else bool(changes),
        "versions": {"python": platform.python_version()}
        | {name: _version(distribution) for name, distribution in _DISTRIBUTIONS.items()},
    }


def not_ignored(paths: Sequence[Path]) -> list[Path]:
    """The paths, all in one folder, that git does not ignore; all paths where there is no git."""
    names = [str(path.absolute()) for path in paths]
    ignored = _git(paths[0].parents[1], "check-ignore", *names) if paths else None
    return [path for path, name in zip(paths, names, strict=True) if name not in (ignored or "").split("\n")]


def _git(folder: Path, *arguments: str) -> str | None:
    try:
        done = subprocess.run(
            ["git", "-C", folder, *arguments],
            capture_output=True,
            encoding="utf-8",
            errors="surrogateescape",  # a name of a file may be any bytes
            timeout=10,
        )
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout.strip() if done.returncode == 0 else None


def _version(distribution: str) -> str | None:
    try:
        return importlib.metadata.version(distribution)
    except importlib.metadata.PackageNotFoundError:
        return None
