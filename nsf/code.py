"""The text of the classes that a configuration names: where one is edited, what it made is made anew."""

import ast
import hashlib
import re
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

from nsf.installed import root_of

_PACKAGE = Path(__file__).parent
#: Bases of classes that add no argument.
_WITHOUT_ARGUMENTS = ("ABC", "Generic", "Protocol")


def text_sum(text: str) -> str:
    """sha256 of a program's text without docstrings, comments and white space."""
    text = re.sub(r'(?s:""".*?""")|#.*', "", text)
    return hashlib.sha256("".join(text.split()).encode()).hexdigest()[:16]


def code_of(node: Any) -> dict[str, str]:
    """Sums of the files that define the classes of a plain tree, by `_target_`; nothing is imported.

    A class of nsf counts with those of the same folder that its file imports, such as its base; one of the
    user with every file of the user that it imports. What cannot be found is left out, and refused where it
    is built.
    """
    return {target: _sum_of(target) for target in sorted(set(_targets(node))) if _home(target)}


def _targets(node: Any) -> Iterator[str]:
    if isinstance(node, dict):
        if isinstance(node.get("_target_"), str):
            yield node["_target_"]
        node = list(node.values())
    if isinstance(node, list):
        for child in node:
            yield from _targets(child)


def arguments(target: str) -> dict[str, str] | None:
    """Names of what a class or function takes, and their types as its text has them; nothing is imported.

    None where the text does not tell.
    """
    home = _home(target)
    return _arguments(home, target.rpartition(".")[2]) if home else None


@cache
def _arguments(path: Path, name: str) -> dict[str, str] | None:
    """Those of a definition in a file: of `__init__`, or the fields of a dataclass and of its bases."""
    definition = next((node for node in tree_of(path).body if getattr(node, "name", None) == name), None)
    if definition is None and (passed := _imported(path).get(name, path)) != path:
        return _arguments(passed, name)
    if isinstance(definition, ast.FunctionDef):
        return _declared((*definition.args.args, *definition.args.kwonlyargs))
    if not isinstance(definition, ast.ClassDef):
        return None
    for node in definition.body:
        if isinstance(node, ast.FunctionDef) and node.name == "__init__":
            return _declared((*node.args.args[1:], *node.args.kwonlyargs))
    names: dict[str, str] = {}
    for base in (ast.unparse(base).partition("[")[0] for base in definition.bases):
        if base not in _WITHOUT_ARGUMENTS:
            inherited = _arguments(_imported(path).get(base, path), base)
            if inherited is None:
                return None
            names |= inherited
    if not any("dataclass" in ast.unparse(decorator) for decorator in definition.decorator_list):
        return names
    return names | _declared(node for node in definition.body if _is_argument(node))


def _declared(nodes: Iterable[ast.arg | ast.AnnAssign]) -> dict[str, str]:
    """Names and types of arguments of a function, or of fields of a dataclass."""
    named = ((node.arg if isinstance(node, ast.arg) else node.target.id, node.annotation) for node in nodes)
    return {name: ast.unparse(kind) if kind else "" for name, kind in named}


def _is_argument(node: ast.stmt) -> bool:
    """Whether a statement of a dataclass is a field that its `__init__` takes."""
    if not (isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name)):
        return False
    value = ast.unparse(node.value) if node.value else ""
    kind = ast.unparse(node.annotation)
    return not ("ClassVar" in kind or kind.endswith("KW_ONLY") or "init=False" in value)


@cache
def _sum_of(target: str) -> str:
    home = _home(target)
    files, left = {home}, [home]
    while left:
        for imported in _imported(left.pop()).values():
            near = imported.parent == home.parent or _PACKAGE not in imported.parents
            if near and imported not in files:
                files.add(imported)
                left.append(imported)
    return text_sum("".join(text_of(path) for path in sorted(files)))


@cache
def _home(target: str) -> Path | None:
    """The file that defines a class, behind the packages that only pass it on."""
    module, _, name = target.rpartition(".")
    path = _file(module)
    while path is not None and path.name == "__init__.py" and not _defines(path, name):
        passed = _imported(path).get(name)
        path = passed if passed != path else None
    return path


def _defines(path: Path, name: str) -> bool:
    return any(getattr(node, "name", None) == name for node in tree_of(path).body)


@cache
def _imported(path: Path) -> dict[str, Path]:
    """Files of nsf and of the user's packages from which a file takes names, by name."""
    files = {}
    for node in ast.walk(tree_of(path)):
        if isinstance(node, ast.ImportFrom):
            for alias in node.names:
                file = _source(path, node, alias.name)
                if file is not None:
                    files[alias.asname or alias.name] = file
    return files


def _source(path: Path, node: ast.ImportFrom, name: str) -> Path | None:
    """The file from which `from … import name` takes a name: a module of that name, or where it says."""
    module = node.module or ""
    if not node.level:
        if _PACKAGE in path.parents and module.partition(".")[0] != _PACKAGE.name:
            return None  # nsf takes nothing from a user's package; looking for one takes 0.03 s
        return _file(f"{module}.{name}") or _file(module)
    folder = path.parents[node.level - 1].joinpath(*filter(None, module.split(".")))
    return _module(folder / name) or _module(folder)


@cache
def tree_of(path: Path) -> ast.Module:
    """The text of such a file as a tree, parsed once; an empty one of a text that is no program."""
    try:
        return ast.parse(text_of(path))
    except SyntaxError:  # which its import reports
        return ast.Module([], [])


def _file(module: str) -> Path | None:
    first, *parts = module.split(".")
    root = _PACKAGE if first == _PACKAGE.name else root_of(first)
    if root is None or not all(map(str.isidentifier, parts)):
        return None
    return _module(root.joinpath(*parts))


def _module(path: Path) -> Path | None:
    return next((p for p in (path.with_suffix(".py"), path / "__init__.py") if p.is_file()), None)


@cache
def text_of(path: Path) -> str:
    """The text of a file of nsf, or of a package of the user, read once."""
    return path.read_text(encoding="utf-8", errors="replace")
