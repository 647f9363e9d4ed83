"""The command line in a process of its own that need not import torch again.

Each call is a fork of this process, which has imported what the stages import when they work; where there is
a GPU, whose libraries survive no fork, of a server process that has. A fault names a fault that the child
brings upon itself at an exact moment, so that no test depends on how fast it runs.
"""

import gc
import importlib
import multiprocessing
import os
import resource
import shutil
import signal
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from multiprocessing import forkserver
from pathlib import Path

import pytest
import torch


@cache
def _context():
    """Forks of this process, or of a server, which finds `preloaded` by its folder."""
    importlib.import_module("preloaded")
    if not torch.cuda.is_available():
        return multiprocessing.get_context("fork")
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["preloaded", "forked"])
    folders = [str(Path(__file__).parent), str(Path(__file__).parents[1]), os.environ.get("PYTHONPATH")]
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", os.pathsep.join(filter(None, folders)))
        forkserver.ensure_running()
    return context


@dataclass(frozen=True)
class Outcome:
    """Exit code (−N after signal N) and what was printed."""

    code: int
    out: str
    err: str


@dataclass(frozen=True)
class SignalAt:
    """Sends itself a signal at the n-th call of `module:Class.function`."""

    where: str
    call: int = 1
    signal: int = signal.SIGINT

    def __call__(self):
        _at(self.where, self.call, lambda: os.kill(os.getpid(), self.signal))


@dataclass(frozen=True)
class GoneAt:
    """Deletes a folder at the n-th call of a function, or moves it."""

    where: str
    call: int
    folder: Path
    moved: Path | None = None

    def __call__(self):
        _at(self.where, self.call, self._go)

    def _go(self):
        if self.moved:
            self.folder.rename(self.moved)
        else:
            shutil.rmtree(self.folder)


@dataclass(frozen=True)
class FileLimit:
    """No file may grow past a number of bytes: what a disk without room does, without being root."""

    size: int

    def __call__(self):
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (self.size, self.size))


@dataclass(frozen=True)
class PlainReport:
    """Reports that draw nothing: pictures have tests of their own, and take seconds."""

    def __call__(self):
        importlib.import_module("nsf.results.report").draw = lambda *_: []
        importlib.import_module("nsf.results.pictures").sections = lambda *_: []


@dataclass(frozen=True)
class BriefReport:
    """Two charts, and of each variant the one picture that a page of many has: the others are drawn alike."""

    def __call__(self):
        importlib.import_module("nsf.results.pictures")._MANY = 0
        report = importlib.import_module("nsf.results.report")
        report.CHARTS = {name: report.CHARTS[name] for name in ("delta", "latent")}


def _at(where, call, act):
    owner, name = _owner(where)
    original, calls = getattr(owner, name), []

    def counted(*arguments, **named):
        calls.append(None)
        if len(calls) == call:
            act()
        return original(*arguments, **named)

    setattr(owner, name, counted)


def _owner(where):
    module, path = where.split(":")
    owner = importlib.import_module(module)
    *parents, name = path.split(".")
    for parent in parents:
        owner = getattr(owner, parent)
    return owner, name


def _child(arguments, environment, folder, faults):
    for number, name in ((1, "out"), (2, "err")):
        os.dup2(os.open(folder / name, os.O_CREAT | os.O_WRONLY | os.O_TRUNC), number)
    sys.stdout, sys.stderr = (os.fdopen(os.dup(n), "w", buffering=1, encoding="utf-8") for n in (1, 2))
    os.environ.update(environment)
    os.chdir(folder)
    gc.freeze()  # as pytest_collection_finish does: an evaluation collects garbage six times
    for fault in faults:
        fault()
    from nsf.cli import main

    torch.set_num_threads(1)
    main(arguments)


def run_nsf(arguments, root: Path, folder: Path, *faults) -> Outcome:
    """`nsf *arguments` with NSF_RUNS = root, from within an empty folder."""
    return begin_nsf(arguments, root, folder, *faults)()


def begin_nsf(arguments, root: Path, folder: Path, *faults, timeout=120) -> Callable[[], Outcome]:
    """The same under way, and what waits for its end."""
    folder.mkdir(parents=True, exist_ok=True)
    environment = {"NSF_RUNS": str(root), "NSF_REPORTS": str(folder / "reports"), "OMP_NUM_THREADS": "1"}
    process = _context().Process(target=_child, args=(list(arguments), environment, folder, faults))
    process.start()

    def end() -> Outcome:
        process.join(timeout)
        if process.exitcode is None:
            process.kill()
            process.join()
            raise AssertionError(f"nsf {arguments} did not end in {timeout} s")
        texts = [(folder / name).read_text() if (folder / name).exists() else "" for name in ("out", "err")]
        return Outcome(process.exitcode, *texts)

    return end
