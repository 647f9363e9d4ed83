"""The package from outside: its layers, its help, its wheel."""

import os
import re
import subprocess
import sys
import sysconfig
import tomllib
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


# -- layers -------------------------------------------------------------------------------------------------


def test_imports_only_point_down():
    command = Path(sys.executable).parent / "lint-imports"
    done = subprocess.run([command, "--no-cache"], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout


def test_every_module_has_a_layer():
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    layers = {name.strip() for layer in contracts[0]["layers"] for name in re.split("[|:]", layer)}
    modules = {path.stem for path in (ROOT / "nsf").glob("*.py")} - {"__init__"}
    packages = {path.parent.name for path in (ROOT / "nsf").glob("*/__init__.py")}
    assert {f"nsf.{name}" for name in modules | packages} == layers


# -- command line -------------------------------------------------------------------------------------------


def nsf(*arguments, **options):
    return subprocess.run(
        [sys.executable, "-m", "nsf.cli", *arguments], capture_output=True, text=True, timeout=600, **options
    )


def test_help_does_not_wait_for_torch():
    """Half a second: 0.04 s without these imports, 3 s with them."""
    code = """
import sys
from contextlib import suppress
from nsf.cli import main
for words in ([], ["train"], ["search"], ["runs"], ["export"]):
    with suppress(SystemExit):
        main([*words, "--help"])
assert not {"torch", "warp", "hydra", "omegaconf", "pandas", "numpy", "rich"} & set(sys.modules)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


# -- wheel --------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    command = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", folder, ROOT]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return next(folder.glob("*.whl"))


def test_wheel_lists_native_code():
    from hatchling.builders.wheel import WheelBuilder  # here, so that tests are collected without it

    listed = {file.distribution_path for file in WheelBuilder(str(ROOT)).recurse_included_files()}
    native = {file.relative_to(ROOT).as_posix() for file in (ROOT / "nsf").rglob("*.h")}
    assert len(native) > 8
    assert native <= listed


@pytest.mark.slow
def test_wheel_carries_configurations_and_experiments(wheel):
    held = set(zipfile.ZipFile(wheel).namelist())
    for folder in ("conf", "experiments"):
        for file in (ROOT / folder).rglob("*.yaml"):
            assert f"nsf/{file.relative_to(ROOT).as_posix()}" in held
    templates = [*(ROOT / "nsf").rglob("templates/*")]
    assert templates
    assert {file.relative_to(ROOT).as_posix() for file in templates} <= held
    assert not [name for name in held if name.startswith("tests")]


@pytest.mark.slow
def test_wheel_runs_from_an_empty_folder(wheel, tiny, tmp_path):
    fresh, empty = tmp_path / "venv", tmp_path / "empty"
    empty.mkdir()
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", fresh], check=True)
    pip = [sys.executable, "-m", "pip", "--python", fresh / "bin" / "python"]
    subprocess.run([*pip, "install", "--no-deps", "--no-index", wheel], check=True, capture_output=True)
    # What the package needs is borrowed. A path in a .pth is searched last and its own .pth files are
    # not read, so the checkout itself stays out of sight.
    site = next((fresh / "lib").glob("python*/site-packages"))
    (site / "borrowed.pth").write_text(sysconfig.get_path("purelib") + "\n")
    outside = {k: v for k, v in os.environ.items() if not k.startswith(("NSF_", "PYTHON"))}

    def run(*command):
        return subprocess.run(
            [str(c) for c in command], cwd=empty, env=outside, capture_output=True, text=True, timeout=900
        )

    where = run(fresh / "bin" / "python", "-c", "from nsf.paths import *; print(CONF, EXPERIMENTS)")
    assert where.stdout.split() == [f"{site}/nsf/conf", f"{site}/nsf/experiments"], where.stderr

    shown = run(fresh / "bin" / "nsf", "run", "--help")
    assert "drucker_prager" in shown.stdout, shown.stderr

    done = run(fresh / "bin" / "nsf", "run", *tiny)
    assert done.returncode == 0, done.stdout + done.stderr
    assert (empty / "reports" / "sand_small" / "index.html").is_file()
