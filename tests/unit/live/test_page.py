"""The one script of the pages, their policy, and what they hold."""

import base64
import hashlib
import re
import shutil
import subprocess
from html import unescape
from pathlib import Path

import numpy as np
import pytest
from packing import unpacked

from nsf.live import page as web
from nsf.mpm import Cuboid, HalfSpace, Motion, Sphere

MODULES = Path(web.__file__).parent / "web"


def test_the_page_has_each_module_once_after_those_that_it_imports(tmp_path):
    text = web.script()
    assert not re.search(r"^(import|export)\b", text, re.MULTILINE)
    for module in MODULES.rglob("*.mjs"):
        for name in re.findall(r"^export class (\w+)", module.read_text(), re.MULTILINE):
            assert text.count(f"class {name} ") <= 1
    assert text.count("class Camera ") == text.count("class Drawing ") == 1
    assert text.index("class Camera ") < text.index("new Camera(")
    node = shutil.which("node")
    if node is None:
        pytest.skip("node is not installed; apt install nodejs")
    (tmp_path / "page.mjs").write_text(text)
    done = subprocess.run([node, "--check", tmp_path / "page.mjs"], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_modules_fit_into_one_script():
    """Each imports what another exports, no two have a name in common, and none ends the script."""
    imported, exported, names = set(), set(), []
    for module in sorted(MODULES.glob("*.mjs")):
        text = module.read_text()
        for given, other in re.findall(r'^import \{ ([^}]+) \} from "\./(\w+)\.mjs";$', text, re.MULTILINE):
            imported |= {(other, name) for name in given.split(", ")}
        declared = re.findall(r"^(export )?(?:async )?(?:function|class|const|let) (\w+)", text, re.MULTILINE)
        exported |= {(module.stem, name) for export, name in declared if export}
        names += [name for _, name in declared]
    assert imported <= exported
    assert len(names) == len(set(names))
    assert "</script" not in web.script()


@pytest.mark.parametrize("connects", [False, True])
def test_the_policy_is_of_the_script_and_the_style_alone(connects):
    page = web.html("title", connects=connects)
    policy = unescape(re.search(r'Content-Security-Policy" content="([^"]*)"', page)[1])
    for kind, pattern in (
        ("script", r'<script type="module">(.*?)</script>'),
        ("style", r"<style>(.*?)</style>"),
    ):
        (text,) = re.findall(pattern, page, re.DOTALL)
        digest = base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
        assert f"{kind}-src 'sha256-{digest}'" in policy
    assert ("connect-src" in policy) == connects


def test_arrays_are_aligned_and_of_known_kinds():
    arrays = {"a": np.arange(3, dtype=np.int8), "b": np.array([[0.5, -1.0]]), "c": np.arange(5, dtype=">i2")}
    header, found = unpacked(web.packed({"title": "é</script>"}, arrays))
    assert header["title"] == "é</script>"
    for name, own in arrays.items():
        np.testing.assert_array_equal(found[name], own)
    with pytest.raises(ValueError, match="a: i8: arrays must be of f4"):
        web.packed({}, {"a": np.arange(3)})


def test_solids_are_told_as_they_are():
    wall = web.solid("wall", HalfSpace(point=[0, 0, 1], normal=[0, 0, 2]))
    assert (wall["shape"], wall["extents"], wall["until"], wall["motion"]) == (
        "half-space",
        [0, 0, 1],
        None,
        None,
    )
    motion = Motion(
        times=[0, 1], translations=[[0, 0, 0], [0, 0, 1]], angles=[0, 90], axis=[0, 0, 2], pivot=[1, 0, 0]
    )
    plate = web.solid("plate", Cuboid(centre=[1, 2, 3], size=[2, 4, 6], motion=motion, until=0.5))
    assert (plate["shape"], plate["extents"], plate["until"]) == ("cuboid", [1, 2, 3], 0.5)
    assert plate["motion"]["angles"] == pytest.approx([0, np.pi / 2])
    assert plate["motion"]["axis"] == [0, 0, 1]
    assert web.solid("ball", Sphere(centre=[0, 0, 0], radius=2))["extents"][0] == 2
