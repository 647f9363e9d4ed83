"""Native code is read from files, and an edited file is compiled anew."""

import sys

import pytest
import warp as wp

from nsf.mpm.native import native_code


@pytest.fixture
def package(tmp_path, monkeypatch):
    """A package with a folder of native code: name, and (file, text) → the file written."""
    folder = tmp_path / "native_of_a_test" / "native"
    folder.mkdir(parents=True)
    (folder.parent / "__init__.py").touch()
    monkeypatch.syspath_prepend(tmp_path)
    yield "native_of_a_test", lambda name, text: (folder / name).write_text(text)
    sys.modules.pop("native_of_a_test", None)


def test_constants_stand_before_the_body(package):
    name, write = package
    write("body.h", "return real(WIDTHS[N]);\n")
    assert native_code(name, "body", real="double", N=1, WIDTHS=(5, 7), FAST=True) == (
        "typedef double real;\n"
        "constexpr int N = 1;\n"
        "constexpr int WIDTHS[] = {5, 7};\n"
        "constexpr bool FAST = true;\n"
        "return real(WIDTHS[N]);\n"
    )


def test_an_edited_file_is_compiled_anew(package):
    """Also one that another includes: Warp tells by the text of the body, which so must hold both."""
    name, write = package

    def found(**constants):
        @wp.func_native(native_code(name, "outer", **constants))
        def native(x: float) -> float: ...

        @wp.kernel(enable_backward=False, module="unique")
        def kernel(x: wp.array(dtype=float)):
            x[0] = native(x[0])

        x = wp.full(1, 2.0, dtype=float, device="cpu")
        wp.launch(kernel, dim=1, inputs=[x], device="cpu")
        return float(x.numpy()[0])

    write("outer.h", '#include "inner.h"\nreturn x;\n')
    write("inner.h", "x *= FACTOR;\n")
    assert found(FACTOR=3) == 6.0
    assert found(FACTOR=5) == 10.0
    write("inner.h", "x += FACTOR;\n")
    assert found(FACTOR=3) == 5.0
    write("outer.h", "return -x;\n")
    assert found(FACTOR=3) == -2.0
