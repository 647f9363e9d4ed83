"""Names that a package imports on first use."""

import importlib
import pkgutil
import sys

import pytest

import nsf

PACKAGES = ["nsf", *(m.name for m in pkgutil.walk_packages(nsf.__path__, "nsf.") if m.ispkg)]
LAZY = [name for name in PACKAGES if hasattr(importlib.import_module(name), "__getattr__")]


def test_there_are_packages_that_wait():
    assert {"nsf", "nsf.data", "nsf.engines", "nsf.scenes"} <= set(LAZY)


@pytest.mark.parametrize("name", LAZY)
def test_every_name_of_a_package_that_waits_is_there(name):
    package = importlib.import_module(name)
    assert all(getattr(package, public).__doc__ is not None for public in package.__all__)
    with pytest.raises(AttributeError, match=f"'{name}' has no attribute 'none'"):
        _ = package.none


def test_a_name_is_imported_when_it_is_asked_for(tmp_path, monkeypatch):
    lines = [
        "from typing import TYPE_CHECKING",
        "from nsf.extras import on_first_use",
        "if TYPE_CHECKING:",
        "    from waiting.home import Name",
        "__getattr__ = on_first_use(__name__)",
    ]
    (tmp_path / "waiting").mkdir()
    (tmp_path / "waiting/__init__.py").write_text("\n".join(lines))
    (tmp_path / "waiting/home.py").write_text("class Name: pass\nclass Other: pass\n")
    monkeypatch.syspath_prepend(tmp_path)
    package = importlib.import_module("waiting")
    assert "waiting.home" not in sys.modules
    assert package.Name.__module__ == "waiting.home"
    with pytest.raises(AttributeError):
        _ = package.Other
    for name in ("waiting", "waiting.home"):
        del sys.modules[name]
