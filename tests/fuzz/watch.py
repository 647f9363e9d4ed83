"""A watch over a case: the files it writes, programs it starts, connections it opens, time it takes."""

import os
import re
import signal
import sys
import tempfile
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from nsf.errors import NSFError

#: Seconds of processors that a case may take; no valid one takes a tenth of it. On a clock they may be more,
#: where others use the machine.
LIMIT = 20.0
_CROWDED = 10
#: [byte] of memory that a case may take beyond what the process had.
MOST_MEMORY = 2 * 2**30
#: Programs that the package itself starts: who made a result is a part of it.
_PROGRAMS = {"git", "nvidia-smi", "uname", "lscpu"}
_STARTS = {"subprocess.Popen", "os.system", "os.exec", "os.posix_spawn", "os.spawn", "pty.spawn", "os.fork"}
_CHANGES = {
    "os.remove",
    "os.rename",
    "os.rmdir",
    "os.chmod",
    "os.chown",
    "os.link",
    "os.symlink",
    "shutil.rmtree",
}
_LOOPBACK = {"127.0.0.1", "::1", "localhost"}

_watched: list["Watch"] = []


@dataclass
class Watch:
    """Deeds of one case that no input may bring about."""

    folder: Path
    deeds: list[str] = field(default_factory=list)

    def sees(self, event: str, arguments: tuple) -> None:
        """Take down a deed, unless it is one that every run does."""
        if event in _STARTS:
            program = arguments[0]
            if isinstance(program, bytes | str | os.PathLike):
                program = Path(os.fsdecode(program)).name
            if program not in _PROGRAMS:
                self.deeds.append(f"started {arguments[:2]}")
        elif (
            event == "open" and isinstance(arguments[1], str) and set(arguments[1]) & set("wax+")
        ) or event in _CHANGES:
            self._changed(arguments[0], arguments[1:] if event in ("os.remove", "os.rmdir") else ())
        elif event == "socket.connect" and not isinstance(arguments[1], str | bytes):
            host = arguments[1][0]
            self.deeds += [f"connected to {host}"] * (host not in _LOOPBACK)

    def _changed(self, path, folders: Sequence[int] = ()) -> None:
        if not isinstance(path, bytes | str | os.PathLike):
            return
        above = [os.readlink(f"/proc/self/fd/{folder}") for folder in folders if folder >= 0]
        path = Path(os.path.abspath(os.path.join(*above, os.fsdecode(path))))
        places = (self.folder, Path.home() / ".cache", Path("/dev"), Path("/proc"))
        in_temporary = path.is_relative_to(tempfile.gettempdir()) and not path.is_relative_to(
            self.folder.parent
        )
        if not in_temporary and not any(path.is_relative_to(place) for place in places):
            self.deeds.append(f"changed {path}")


def _hook(event: str, arguments: tuple) -> None:
    if _watched:
        _watched[-1].sees(event, arguments)


class Hang(BaseException):
    """A case took longer than it may; not an Exception, so that nothing takes it for a fault of the input."""


@contextmanager
def _limited(seconds: float) -> Iterator[None]:
    def ring(*_):
        raise Hang

    clocks = {signal.SIGPROF: signal.ITIMER_PROF, signal.SIGALRM: signal.ITIMER_REAL}
    before = {number: signal.signal(number, ring) for number in clocks}
    signal.setitimer(signal.ITIMER_PROF, seconds)
    signal.setitimer(signal.ITIMER_REAL, _CROWDED * seconds)
    try:
        yield
    finally:
        for number, clock in clocks.items():
            signal.setitimer(clock, 0)
            signal.signal(number, before[number])


def _peak(reset: bool = False) -> int:
    """The most memory [byte] that this process held since the last reset."""
    if reset:
        Path("/proc/self/clear_refs").write_text("5")
    return 1024 * int(re.search(r"VmHWM:\s+(\d+)", Path("/proc/self/status").read_text())[1])


_hooked: list[bool] = []


def outcome(run: Callable[[], object], altered: bool, folder: Path, limit: float = LIMIT) -> tuple[str, str]:
    """Run a case.

    Args:
        run: the case.
        altered: it hands over altered data, which must not be opened as if it were whole.
        folder: in which it may write.
        limit: [s] that it may take.

    Returns:
        "accepted", "refused", or a violation ("code", "hang", "memory", "traceback", "altered"); and what was
        said.
    """
    if not _hooked:
        sys.addaudithook(_hook)
        _hooked.append(True)
    watch, writes_none = Watch(folder), sys.dont_write_bytecode
    sys.dont_write_bytecode = True  # of a module that the case is the first to import
    before = _peak(reset=True)
    _watched.append(watch)
    try:
        with _limited(limit):
            run()
        kind, said = ("altered", "opened") if altered else ("accepted", "")
    except NSFError as error:
        kind, said = "refused", str(error)
    except SystemExit as stop:
        accepted = "altered" if altered else "accepted"
        kind, said = (
            {0: accepted, None: accepted, 2: "refused"}.get(stop.code, "traceback"),
            f"exit {stop.code}",
        )
    except Hang:
        kind, said = "hang", f"longer than {limit:g} s"
    except BaseException as error:
        if isinstance(error, KeyboardInterrupt):
            raise
        kind, said = "traceback", "".join(traceback.format_exception(error)[-3:])
    finally:
        _watched.remove(watch)
        sys.dont_write_bytecode = writes_none
    if (taken := _peak() - before) > MOST_MEMORY:
        kind, said = "memory", f"{taken / 2**30:.1f} GiB"
    if watch.deeds:
        return "code", "; ".join(watch.deeds[:3])
    return kind, said
