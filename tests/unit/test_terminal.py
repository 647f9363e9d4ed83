"""Terminals that are not UTF-8, folders that cannot be written, too little memory: a line, no traceback."""

import io
import sys

import pytest

from nsf.cli import main
from nsf.errors import StorageError, out_of_memory
from nsf.mpm import device


@pytest.fixture
def terminal(monkeypatch):
    """Standard output of an encoding, as bytes."""

    def make(encoding):
        stream = io.TextIOWrapper(io.BytesIO(), encoding=encoding, errors="strict", write_through=True)
        monkeypatch.setattr(sys, "stdout", stream)
        return stream.buffer

    return make


PLAN = ["plan", "scene=drop", "scale=small"]


@pytest.mark.parametrize(
    ("encoding", "words"),
    [*(("ascii", words) for words in (["--help"], ["run", "--help"], PLAN, ["runs"])), ("cp1252", PLAN)],
)
def test_what_a_terminal_cannot_show_is_replaced(terminal, encoding, words, tmp_path, monkeypatch):
    monkeypatch.setenv("NSF_RUNS", str(tmp_path))
    monkeypatch.setattr(sys, "stderr", io.TextIOWrapper(io.BytesIO(), encoding=encoding, errors="strict"))
    shown = terminal(encoding)
    with pytest.raises(SystemExit) as end:
        main(words)
    assert end.value.code in (0, None)
    sys.stderr.flush()
    assert (shown.getvalue() + sys.stderr.buffer.getvalue()).decode(encoding)


def test_a_name_that_is_no_text_can_be_printed(terminal):
    """A letter that a file's name has and no encoding, as the shell hands it over."""
    shown = terminal("utf-8")
    with pytest.raises(SystemExit):
        main(["--help"])
    print("mesh=\udcff.stl")
    assert b"mesh=?.stl" in shown.getvalue()


def test_a_job_of_a_sweep_on_such_a_terminal(terminal, tmp_path, monkeypatch):
    words = ["simulate", "-m", "scene=drop", "scale=small", "scene.dx=0.08", "scene.steps=2", "device=cpu"]
    monkeypatch.setenv("NSF_RUNS", str(tmp_path))
    shown = terminal("ascii")
    with pytest.raises(SystemExit) as end:
        main([*words, "scene.parameters.E.unit='µPa'"])
    assert end.value.code in (0, None)
    assert b"scene.parameters.E.unit='?Pa'" in shown.getvalue()


@pytest.fixture
def fresh_check():
    device._check_kernel_cache.cache_clear()
    yield
    device._check_kernel_cache.cache_clear()


@pytest.mark.usefixtures("fresh_check")
class TestKernelCache:
    def test_cannot_be_made(self, monkeypatch):
        monkeypatch.setattr(device.wp.config, "kernel_cache_dir", "/proc/nowhere/1.0")
        with pytest.raises(StorageError, match=r"/proc/nowhere/1\.0: No such file.*; set WARP_CACHE_PATH to"):
            device.warp_device("cpu")

    def test_read_only(self, monkeypatch, tmp_path):
        monkeypatch.setattr(device.wp.config, "kernel_cache_dir", str(tmp_path))
        monkeypatch.setattr(device.os, "access", lambda path, mode: False)
        with pytest.raises(StorageError, match="it is read-only; set WARP_CACHE_PATH"):
            device.warp_device("cpu")


class TestMemory:
    @pytest.mark.parametrize(
        "error",
        [
            MemoryError(),
            OSError(12, "Cannot allocate memory"),
            ImportError("libtorch_cpu.so: failed to map segment from shared object"),
            RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried to allocate 8 bytes"),
        ],
    )
    def test_a_line(self, monkeypatch, capsys, error):
        def refuse(arguments):
            raise RuntimeError("a library's words") from error

        monkeypatch.setattr("nsf.cli._dispatch", refuse)
        with pytest.raises(SystemExit) as end:
            main(["runs"])
        assert end.value.code == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith("error: memory ran out")
        assert "ulimit -v" in line

    def test_another_error_is_a_fault(self):
        assert not out_of_memory(RuntimeError("a fault"))
        assert not out_of_memory(None)


@pytest.mark.parametrize(
    ("word", "told"),
    [
        (f"scene.steps={10**20}", f"={10**20} must be a whole number of at most 2147483647"),
        (f"evaluation.trials={10**20}", "of at most 2147483647"),
        ("scene.geometry.mesh=~/a.obj", "write 'scene.geometry.mesh=\"~/a.obj\"'"),
        ("scene.geometry.mesh=kürbis.obj", "write 'scene.geometry.mesh=\"kürbis.obj\"'"),
        ("scene.gravity=[0,0", "quote brackets, commas and spaces"),
    ],
)
def test_what_plan_refuses(capsys, word, told):
    with pytest.raises(SystemExit) as end:
        main(["plan", "scene=drop", word])
    assert end.value.code == 2
    assert told in capsys.readouterr().err


def test_a_unit_that_a_terminal_would_obey_is_not_printed(capsys):
    with pytest.raises(SystemExit):
        main(["plan", "scene=drop", "scale=small", 'scene.parameters.E.unit="\x1b[2J"'])
    shown = capsys.readouterr()
    assert "\x1b" not in shown.out + shown.err
