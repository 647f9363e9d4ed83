"""`nsf init`: a small project of the user, with a law, a scene, an experiment and a test."""

import importlib.util
import json
import keyword
import os
import re
import shutil
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from nsf.errors import ConfigError, StorageError
from nsf.scenes.resolution import thinnest_part
from nsf.scenes.shapes import Mesh

_TEMPLATE = Path(__file__).parent / "template"
_NAME = "PROJECT"  # which the project's name takes the place of, in texts and in paths
_MESH = "meshes/bracket.obj"  # which, likewise, a mesh of the user takes the place of
#: [m] longest edge of the template's mesh, and cells of its scene along it and across its thinnest part.
_EXTENT, _CELLS, _ACROSS = 0.3, 7.5, 2.5
#: Cells along a mesh, at most: full-order runs of it still take seconds to a minute.
_MOST_CELLS = 24.0
#: Exponents (a, b) of s^a k^b that multiply the numbers of a key, for a mesh s times as long as the
#: template's with k times the cells along it, so more slender. Velocities √(gL), stresses ρgL, times √(L/g)
#: keep the motion. By bending alone E goes by k² and τ_Y by k; half of that, as a body is also sheared and
#: crushed: an L 2.5 times as slender then deforms by 17 % of its length, the template's by 24 %.
_EXPONENTS = {
    "E": (1.0, 1.0), "yield_stress": (1.0, 0.5), "size": (1.0, 0.0),
    "base": (1.0, 0.0), "point": (1.0, 0.0), "dx": (1.0, -1.0), "dt": (0.5, -1.5), "steps": (0.0, 1.5),
    "velocity": (0.5, 0.0),
}  # fmt: skip


def write_project(folder: Path, mesh: Mesh | None = None) -> None:
    """Write a project into a folder that is not there yet, or is empty.

    Its module and scene have the folder's name, with `_` for what such a name cannot have.

    Args:
        folder: of the project.
        mesh: of the body, with its unit; the template's by default. The file is copied, and the scene scaled
            to it.

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
    names = {_NAME: name}
    scale = str
    if mesh is not None:
        file = Path(mesh.path).expanduser()
        names[f"path: {_MESH}"] = f"path: {json.dumps(f'meshes/{file.name}')}"
        scale = _scaling(mesh)
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder.parent) as partial:
            whole = Path(partial) / "project"
            for path in sorted(_TEMPLATE.rglob("*")):
                if path.is_file() and "__pycache__" not in path.parts:
                    text = path.read_text(encoding="utf-8")
                    text = scale(text) if path.parent.name in ("scene", "material") else text
                    _write(whole / _renamed(str(path.relative_to(_TEMPLATE)), names), _renamed(text, names))
            if mesh is not None:
                shutil.rmtree(whole / "meshes")
                (whole / "meshes").mkdir()
                shutil.copyfile(file, whole / "meshes" / file.name)
            shutil.copymode(folder if folder.exists() else folder.parent, whole)
            whole.rename(folder)
    except OSError as error:
        raise StorageError(f"{folder} cannot be written: {error.strerror}; name another folder") from error


def _renamed(text: str, names: Mapping[str, str]) -> str:
    return re.sub("|".join(map(re.escape, names)), lambda name: names[name[0]], text)


def _write(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")


def _scaling(mesh: Mesh) -> Callable[[str], str]:
    """The change of the template's scene that makes it one of a mesh."""
    lower, upper = mesh.bounds
    extent = float((upper - lower).max())
    thickness = min(thinnest_part(mesh, 0.5 * extent, mesh.sample(32)), extent)
    s = extent / _EXTENT
    k = float(np.clip(_ACROSS * extent / thickness, _CELLS, _MOST_CELLS)) / _CELLS

    def scaled(line: str) -> str:
        key, colon, rest = line.partition(":")
        value, comment = re.fullmatch("(.*?)(  #.*)?", rest).groups("")
        if key.strip() in ("unit", "up"):
            value = f" {getattr(mesh, key.strip())}"
        elif key.strip() in _EXPONENTS:
            a, b = _EXPONENTS[key.strip()]
            value = re.sub(r"(?<![\w.])\d+(\.\d+)?", lambda n: _rounded(n[0], s**a * k**b), value)
        return key + colon + value + comment

    said = f"# Scaled to the mesh, which is {extent:.3g} m long and about {thickness:.2g} m at its thinnest."
    return lambda text: "\n".join(map(scaled, text.split("\n"))).replace("# Scaled to the mesh.", said)


def _rounded(number: str, factor: float) -> str:
    """A number times a factor, to three digits, whole if it was."""
    value = float(f"{float(number) * factor:.3g}")
    return str(value if "." in number else max(1, round(value)))
