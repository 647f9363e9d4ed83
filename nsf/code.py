"""The text of the classes that a configuration names: where one is edited, what it made is made anew."""

import ast
import hashlib
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

_PACKAGE = Path(__file__).parent
#: Bases of classes that add no argument.
_WITHOUT_ARGUMENTS = ("ABC", "Generic", "Protocol")


def text_sum(text: str) -> str:
    """sha256 of a program's text without docstrings, comments and white space."""
    text = re.sub(r'(?s:""".*?""")|#.*', "", text)
    return hashlib.sha256("".join(text.split()).encode()).hexdigest()[:16]


def code_of(node: Any) -> dict[str, str]:
    """Sums of the files that define the classes of a plain tree, by `_target_`; nothing is imported.

    A class counts with those of its own package that its file imports, such as its base. What cannot be found
    is left out; it is refused where it is built.
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


def arguments(target: str) -> set[str] | None:
    """Names of what a class or function takes, without an import; None where its text does not tell."""
    home = _home(target)
    return _arguments(home, target.rpartition(".")[2]) if home else None


@cache
def _arguments(path: Path, name: str) -> set[str] | None:
    """Those of a definition in a file: of `__init__`, or the fields of a dataclass and of its bases."""
    definition = next((node for node in _tree(path).body if getattr(node, "name", None) == name), None)
    if isinstance(definition, ast.FunctionDef):
        return {one.arg for one in (*definition.args.args, *definition.args.kwonlyargs)}
    if not isinstance(definition, ast.ClassDef):
        return None
    for node in definition.body:
        if isinstance(node, ast.FunctionDef) and node.name == "__init__":
            return {one.arg for one in (*node.args.args[1:], *node.args.kwonlyargs)}
    names: set[str] = set()
    for base in (ast.unparse(base).partition("[")[0] for base in definition.bases):
        if base not in _WITHOUT_ARGUMENTS:
            inherited = _arguments(_imported(path).get(base, path), base)
            if inherited is None:
                return None
            names |= inherited
    if not any("dataclass" in ast.unparse(decorator) for decorator in definition.decorator_list):
        return names
    return names | {node.target.id for node in definition.body if _is_argument(node)}


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
            if imported.parent == home.parent and imported not in files:
                files.add(imported)
                left.append(imported)
    return text_sum("".join(text_of(path) for path in sorted(files)))


@cache
def _home(target: str) -> Path | None:
    """The file that defines a class, behind the packages that only pass it on."""
    module, _, name = target.rpartition(".")
    path = _file(module)
    while path is not None and path.name == "__init__.py" and (passed := _imported(path).get(name)) != path:
        path = passed
    return path


@cache
def _imported(path: Path) -> dict[str, Path]:
    """Files of this package from which a file takes names, by name."""
    files = {}
    for node in ast.walk(_tree(path)):
        if isinstance(node, ast.ImportFrom) and node.module and not node.level:
            for alias in node.names:
                file = _file(f"{node.module}.{alias.name}") or _file(node.module)
                if file is not None:
                    files[alias.asname or alias.name] = file
    return files


@cache
def _tree(path: Path) -> ast.Module:
    try:
        return ast.parse(text_of(path))
    except SyntaxError:  # which its import reports
        return ast.Module([], [])


def _file(module: str) -> Path | None:
    first, *parts = module.split(".")
    if first != _PACKAGE.name or not all(map(str.isidentifier, parts)):
        return None
    path = _PACKAGE.joinpath(*parts)
    return next((p for p in (path.with_suffix(".py"), path / "__init__.py") if p.is_file()), None)


@cache
def text_of(path: Path) -> str:
    """The text of a file of this package, read once."""
    return path.read_text(encoding="utf-8", errors="replace")
