"""The text that the modal engine mirrors: an edit of the reference is what runs.

The kernels compute what the reference said when they were written. `mirrors.json` has the sha256 of each
function that they stand for, docstrings, comments and white space apart. Where one reads otherwise, in its
file or replaced in a running program, the engine refuses, and the reference steps instead. Once the kernels
follow the new text, `make mirrors` writes the table anew.
"""

import ast
import inspect
import json
import pkgutil
import sys
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path

from nsf.code import text_of, text_sum, tree_of

TABLE = Path(__file__).with_name("mirrors.json")
#: The text that the kernels stand for: classes, of which every function counts, and functions.
MIRRORED = (
    "nsf.dynamics.step:Step",
    "nsf.dynamics.step:SearchingStep",
    "nsf.engines.reference:Reference.spans",
    "nsf.dynamics.span:Span.first_rate",
    "nsf.dynamics.setup:first_change",
    "nsf.dynamics.setup:first_changes",
    "nsf.dynamics.inference:Inference",
    "nsf.dynamics.sources:Sources",
    "nsf.dynamics.sources:StressNeural",
    "nsf.dynamics.sources:StressFromDeformation",
    "nsf.dynamics.integration:NeighbourSearch.integration_mask",
    "nsf.dynamics.integration:NeighbourSearch.mark_nodes",
    "nsf.dynamics.integration:NeighbourSearch.flag_particles",
    "nsf.dynamics.integration:_kernels",
    "nsf.dynamics.projection:GaussNewton",
    "nsf.dynamics.projection:Taylor",
    "nsf.dynamics.projection:_equations",
    "nsf.dynamics.projection:_weighted",
    "nsf.dynamics.projection:_normal_equations",
    "nsf.dynamics.projection:_rms",
    "nsf.dynamics.latent:LatentRecord.add",
    "nsf.dynamics.latent:LatentRecord.predicted",
    "nsf.kinematics.fields.basis:BasisManifold.restrict",
    "nsf.kinematics.fields.modal:at_rate",
    "nsf.kinematics.fields.modal:ModalField.at",
    "nsf.kinematics.fields.modal:RestrictedField",
    "nsf.kinematics.fields.modal:ModalRestriction",
    "nsf.kinematics.fields.networks:FullyConnected.forward",
    "nsf.kinematics.fields.networks:FullyConnected.forward_and_tangents",
)


def edits() -> dict[str, str]:
    """sha256 of the functions that do not read as in the table, by name; of one that is gone, empty.

    Before the reference is imported its files are read, since nothing can have been replaced yet.
    """
    recorded, now = _recorded(), _digests() if "nsf.dynamics" in sys.modules else _digests_on_disk()
    names = sorted(recorded.keys() | now.keys())
    return {name: now.get(name, "") for name in names if recorded.get(name) != now.get(name)}


def write() -> None:
    """Make the table of the texts as they are."""
    TABLE.write_text(json.dumps(_digests(), indent=1) + "\n", encoding="utf-8")


@cache
def _recorded() -> dict[str, str]:
    return json.loads(TABLE.read_text(encoding="utf-8"))


def _digests() -> dict[str, str]:
    return {name: _digest(function) for mirrored in MIRRORED for name, function in _functions(mirrored)}


@cache
def _digests_on_disk() -> dict[str, str]:
    """As `_digests`, of the text of the files; nothing is imported."""
    digests = {}
    for mirrored in MIRRORED:
        module, _, name = mirrored.partition(":")
        path = Path(__file__).parents[2].joinpath(*module.split(".")[1:]).with_suffix(".py")
        for inner, node in _defined(tree_of(path), name):
            lines = text_of(path).splitlines(keepends=True)
            first = min([node.lineno, *(decorator.lineno for decorator in node.decorator_list)])
            digests[f"{mirrored}.{inner}".rstrip(".")] = text_sum("".join(lines[first - 1 : node.end_lineno]))
    return digests


def _defined(tree: ast.AST, name: str) -> Iterator[tuple[str, ast.FunctionDef]]:
    """The function of a dotted name, or each of the class of that name with its own name."""
    kinds = (ast.FunctionDef, ast.ClassDef)
    for part in name.split("."):
        tree = next((n for n in ast.iter_child_nodes(tree) if isinstance(n, kinds) and n.name == part), tree)
    if isinstance(tree, ast.FunctionDef):
        yield "", tree
        return
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.FunctionDef):
            yield node.name, node


def _functions(mirrored: str) -> Iterator[tuple[str, Callable]]:
    """Names and functions of an entry of `MIRRORED`."""
    mirror = pkgutil.resolve_name(mirrored)
    members = vars(mirror) if isinstance(mirror, type) else {"": mirror}
    for name, member in members.items():
        # Of a property, a cached one, or what functools wraps, the function within.
        function = inspect.unwrap(getattr(member, "fget", None) or getattr(member, "func", None) or member)
        if callable(function) and not _generated(function):
            yield f"{mirrored}.{name}".rstrip("."), function


def _generated(function: Callable) -> bool:
    """Whether no file has its text: a method that a dataclass wrote."""
    return getattr(getattr(function, "__code__", None), "co_filename", "") == "<string>"


@cache
def _digest(function: Callable) -> str:
    """sha256 of a function's text; another for each that has none."""
    try:
        text = inspect.getsource(function)
    except (OSError, TypeError):
        text = repr(function)
    return text_sum(text)
