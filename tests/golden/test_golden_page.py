"""The numbers that a page gets, and the steps that its script takes under node.

A page holds single precision, or less: a last bit of double precision may become one of single.
"""

import shutil

import pytest
from chains import close, page, read


@pytest.mark.parametrize("scene", ["sand", "block"])
def test_a_page_is_the_same(chains, scene, tmp_path):
    wanted = read("page")[scene]
    if shutil.which("node") is None:
        wanted.pop("steps")
    close(page(chains, scene, tmp_path), wanted, 1e-6, scene)
