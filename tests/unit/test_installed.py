"""Classes of packages that the user installed for nsf: named by `_target_`, and nothing else is imported."""

import sys

import pytest

from nsf import code, config, doctor, installed
from nsf.errors import ConfigError

FILES = {
    "mine-1.0.dist-info/METADATA": "Metadata-Version: 2.1\nName: mine\nVersion: 1.0\n",
    "mine-1.0.dist-info/entry_points.txt": "[nsf]\nmine = mine.laws\nbroken = broken\n",
    "mine/__init__.py": "",
    "mine/other.py": "raise RuntimeError('imported')\n",
    "mine/laws/__init__.py": (
        "from dataclasses import dataclass\n\nfrom nsf.mpm.materials import Hencky, Material\n\n"
        "from .core import FACTOR\n\n\n"
        "@dataclass(frozen=True)\nclass Stiff(Hencky):\n    factor: float = FACTOR\n\n\n"
        "class Unfinished(Material):\n    pass\n\n\nclass Other:\n    pass\n"
    ),
    "mine/laws/core.py": "FACTOR = 2.0\n",
    "broken.py": "import a_module_that_is_not_there\n",
    "stranger.py": "raise RuntimeError('imported')\n",
}
LAW = {"_target_": "mine.laws.Stiff", "E": 1e3, "nu": 0.3}


def forget() -> None:
    for cached in (installed.entry_points, installed.root_of, code._sum_of, code._home, code._imported):
        cached.cache_clear()
    for cached in (code.tree_of, code._arguments, code.text_of):
        cached.cache_clear()
    for name in [name for name in sys.modules if name.partition(".")[0] in ("mine", "broken")]:
        del sys.modules[name]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    for name, text in FILES.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    forget()
    yield tmp_path
    forget()


@pytest.mark.usefixtures("folder")
def test_a_class_of_an_entry_point_is_built():
    assert config.build(LAW, "material").factor == 2.0
    assert code.arguments("mine.laws.Stiff") == {"E": "float", "nu": "float", "factor": "float"}
    assert "mine       mine.laws of mine 1.0: there" in doctor.report()
    assert "broken of mine 1.0: broken cannot be imported, ModuleNotFoundError" in doctor.report()


def test_a_broken_module_of_a_package_is_named(folder):
    (folder / "mine/laws/torn.py").write_text("from .core import OTHER\n")
    (folder / "mine/laws/__main__.py").write_text("raise RuntimeError('run')\n")
    assert "mine.laws of mine 1.0: mine.laws.torn cannot be imported, ImportError: " in doctor.report()
    assert "RuntimeError" not in doctor.report()


@pytest.mark.usefixtures("folder")
@pytest.mark.parametrize(
    ("target", "told"),
    [
        (
            "stranger.Law",
            "is refused; name a Material of nsf.mpm.materials, or of an installed package that declares",
        ),
        ("mine.other.Law", "is refused; name a Material"),
        ("mine.laws.Other", "is no Material; name one of nsf.mpm.materials, or of an installed package"),
        ("mine.laws.Missing", "does not exist"),
        ("mine.laws.Unfinished", "is abstract; define functions, stretches_of"),
        (
            "broken.Law",
            "cannot be imported, ModuleNotFoundError: .*mend broken, the entry point 'broken' of mine",
        ),
        ("mine.laws.core.FACTOR", "is no Material"),
    ],
)
def test_all_else_is_refused_in_one_line(target, told):
    with pytest.raises(ConfigError, match=f"^material: _target_: {target} {told}") as refused:
        config.build(LAW | {"_target_": target}, "material")
    assert "\n" not in str(refused.value)
    assert "stranger" not in sys.modules
    assert "mine.other" not in sys.modules


@pytest.mark.usefixtures("folder")
def test_a_misspelt_value_of_it_is_refused():
    with pytest.raises(
        ConfigError, match=r"unknown key 'material.factr' of mine.laws.Stiff; did you mean material.factor"
    ):
        config.load(["material._target_=mine.laws.Stiff", "+material.factr=3"], "point")
    with pytest.raises(ConfigError, match=r"mine.laws.Other is no Material"):
        config.load(["material._target_=mine.laws.Other", "+material.factr=3"], "point")


def test_an_edit_of_its_files_is_another_run(folder):
    before = code.code_of({"material": LAW})
    (folder / "mine/laws/core.py").write_text("FACTOR = 3.0\n")
    forget()
    assert before
    assert code.code_of({"material": LAW}) != before


def test_the_current_folder_installs_nothing(folder, monkeypatch):
    monkeypatch.chdir(folder)
    forget()
    with pytest.raises(ConfigError, match="is refused"):
        config.build(LAW, "material")
