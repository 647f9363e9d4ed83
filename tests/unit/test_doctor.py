"""`nsf doctor` tells what is there, and what is not."""

import importlib.metadata
import re

import pytest

from nsf import doctor
from nsf.cli import main


@pytest.fixture
def told(tmp_path, monkeypatch, capsys):
    """What `nsf doctor` prints, with empty folders."""
    monkeypatch.setenv("NSF_RUNS", str(tmp_path / "runs"))
    monkeypatch.setenv("NSF_REPORTS", str(tmp_path / "reports"))

    def call():
        with pytest.raises(SystemExit) as end:
            main(["doctor"])
        assert not end.value.code
        return capsys.readouterr().out

    return call


def line(name: str, text: str) -> str:
    return re.search(rf"^  {name} +(.*)$", text, re.MULTILINE)[1]


def test_extras_that_are_missing(told, monkeypatch):
    required = [
        "numpy>=2",
        'pytest>=1; extra == "track"',
        'no-such-thing>=2; extra == "export"',
        'pytest>=1; extra == "export"',
        'pytest>=9999; extra == "mesh"',
        'no-such-thing; extra == "dev"',
    ]
    monkeypatch.setattr(importlib.metadata, "requires", lambda name: required)
    extras = {"Provides-Extra": ["track", "export", "mesh", "dev"]}
    held = type("Held", (), {"get_all": lambda self, key: extras[key]})()
    monkeypatch.setattr(importlib.metadata, "metadata", lambda name: held)
    text = told()
    assert line("track", text) == "there"
    assert line("export", text) == "missing no-such-thing: pip install 'nsf[export]'"
    assert line("mesh", text) == "missing pytest: pip install 'nsf[mesh]'"
    assert "dev" not in text.split("extras:")[1]


def test_what_is_broken_does_not_hide_the_rest(told, monkeypatch):
    def broken():
        yield "cpu        1 core"
        raise OSError("libcuda.so.1: cannot open")

    monkeypatch.setattr(doctor, "_devices", broken)
    text = told()
    assert line("cpu", text) == "1 core"
    assert line("warning", text) == "OSError: libcuda.so.1: cannot open"
    assert "extras:" in text
