"""An edited class is another input: the sum of its text is part of what names a run."""

import pytest

from nsf import code
from nsf.code import code_of

FILES = {
    "sampling/__init__.py": "from nsf.sampling.own import Own\n",
    "sampling/own.py": "from nsf.sampling.base import Base\n\nclass Own(Base):\n    n = 1\n",
    "sampling/base.py": '"""Text."""\n\nclass Base:\n    pass\n',
    "sampling/other.py": "class Other:\n    pass\n",
    "vectors.py": "def length(): pass\n",
}


@pytest.fixture
def package(tmp_path, monkeypatch):
    """A package in which files are edited; sums are found anew after each edit."""
    folder = tmp_path / "nsf"
    for name, text in FILES.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    monkeypatch.setattr(code, "_PACKAGE", folder)

    def edited(name: str = "", text: str = "") -> dict[str, str]:
        if name:
            (folder / name).write_text(text)
        for cached in (code._sum_of, code._home, code._imported, code.text_of):
            cached.cache_clear()
        return code_of({"sampler": {"_target_": "nsf.sampling.Own", "size": 3}, "seed": 0})

    yield edited
    for cached in (code._sum_of, code._home, code._imported, code.text_of):
        cached.cache_clear()


@pytest.mark.parametrize("name", ["sampling/own.py", "sampling/base.py"])
def test_an_edit_of_the_class_or_its_base_counts(package, name):
    before = package()
    assert list(before) == ["nsf.sampling.Own"]
    assert package(name, FILES[name] + "    k = 2\n") != before


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("sampling/base.py", '"""Other text."""\n\n\nclass Base:  # a word\n    pass\n'),
        ("sampling/other.py", "class Other:\n    k = 2\n"),
    ],
)
def test_words_and_other_classes_do_not(package, name, text):
    assert package() == package(name, text)


def test_a_file_that_is_no_program_still_counts(package):
    before = package()
    assert package("sampling/own.py", "class Own(:\n") != before


def test_classes_that_are_not_there_are_left_to_those_who_build_them(package):
    assert code_of({"_target_": "nsf.sampling.gone.Gone"}) == {}
    assert code_of({"_target_": "nsf./etc/passwd.X"}) == {}
    assert code_of({"_target_": "os.system", "more": [{"_target_": 5}]}) == {}
