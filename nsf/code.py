"""The text of the classes that a configuration names: where one is edited, what it made is made anew."""

import ast
import hashlib
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

_PACKAGE = Path(__file__).parent


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


@cache
def _sum_of(target: str) -> str:
    home = _home(target)
    found, left = {home}, [home]
    while left:
        for imported in _imported(left.pop()).values():
            if imported.parent == home.parent and imported not in found:
                found.add(imported)
                left.append(imported)
    return text_sum("".join(text_of(path) for path in sorted(found)))


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
    try:
        tree = ast.parse(text_of(path))
    except SyntaxError:  # told of where the file is imported
        return {}
    found = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module and not node.level:
            for alias in node.names:
                own = _file(f"{node.module}.{alias.name}") or _file(node.module)
                if own is not None:
                    found[alias.asname or alias.name] = own
    return found


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
