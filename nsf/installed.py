"""Python that the user installed for nsf: distributions that declare the entry point group `nsf`.

A configuration may name their classes, and no others outside nsf. What the current folder holds is not
installed, though `python -m` looks there.
"""

import importlib.util
import sys
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint


@cache
def entry_points() -> "tuple[EntryPoint, ...]":
    """Those of the group `nsf`, in order of their names; nothing is imported."""
    from importlib.metadata import distributions  # 0.03 s that most commands need not pay

    here = Path.cwd()
    folders = [folder for folder in sys.path if folder and Path(folder).resolve() != here]
    points = (point for one in distributions(path=folders) for point in one.entry_points)
    return tuple(sorted((point for point in points if point.group == "nsf"), key=lambda point: point.name))


def entry_point_of(target: str) -> "EntryPoint | None":
    """The entry point whose module, or package, holds a class by its dotted name."""
    return next((point for point in entry_points() if target.startswith(f"{point.module}.")), None)


@cache
def root_of(package: str) -> Path | None:
    """The folder of an installed package of an entry point, or the path of its one module without `.py`."""
    if not any(point.module.partition(".")[0] == package for point in entry_points()):
        return None
    spec = importlib.util.find_spec(package)
    if spec is None or not spec.origin:
        return None
    origin = Path(spec.origin)
    return origin.parent if origin.name == "__init__.py" else origin.with_suffix("")
