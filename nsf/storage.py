"""Files that appear whole or not at all, and a full disk that says so."""

import errno
import hashlib
import json
import math
import os
import shutil
import stat
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from nsf.errors import StorageError

_SPACE = "free some space, or write to another disk (NSF_RUNS, NSF_REPORTS)"
_ACCESS = "make the folder writable, or write elsewhere (NSF_RUNS, NSF_REPORTS)"
_GONE = "its folder was deleted or moved meanwhile"
_PLACE = "a file stands where a folder is needed; write elsewhere (NSF_RUNS, NSF_REPORTS)"
#: What to do where a folder has gone as it was written.
AGAIN = "run the same command again, and leave the folder until it is done"
_REMEDIES = {
    errno.ENOSPC: _SPACE,
    errno.EDQUOT: _SPACE,
    errno.EFBIG: "raise the limit on file size (ulimit -f)",
    errno.EACCES: _ACCESS,
    errno.EPERM: _ACCESS,
    errno.EROFS: _ACCESS,
    errno.EISDIR: "a folder stands where the file is needed; remove it",
}
# torch.save reports a full disk as a RuntimeError without a cause; a file system this empty gives it away.
_FULL_BYTES = 64 * 1024
_PARTIAL = ".partial-"  # of hidden folders in which files are written
_LOCK_SECONDS = 0.2  # between two looks at a lock that another process has
# Ends a sealed file, with the sha256 of all before it in hex; readers of archives pass over what follows one.
_SEAL = b"\nsha256 "
_SEAL_BYTES = len(_SEAL) + 64
_PIECE = 2**20  # [byte] read at once


@contextmanager
def writing(path: str | Path, sealed: bool = False) -> Iterator[Path]:
    """Yield a temporary path that becomes `path` only if the block succeeds.

    The temporary file keeps the name (savers choose a format by the suffix)
    and lies in a hidden folder beside the target, on the same file system, so
    the final rename is atomic. On any exception, an interrupt included, it is
    removed and an earlier file of that name stays as it was.

    Args:
        path: where the file shall be; missing folders are made.
        sealed: end it with its own sha256, for `intact`: an archive (of torch, of NumPy) that a run reads
            which goes on after an interrupt, before any manifest records the file.

    Raises:
        StorageError: no space, no permission or no writable file system, or the folder was deleted meanwhile.
    """
    path = Path(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        folder = Path(tempfile.mkdtemp(prefix=_PARTIAL, dir=path.parent))
    except OSError as error:
        raise _refused(path, error) from error
    try:
        partial = folder / path.name
        yield partial
        if sealed:
            with partial.open("ab") as file:
                file.write(_SEAL + _sum(partial, partial.stat().st_size))
        _flush(partial)
        os.replace(partial, path)
    except (OSError, RuntimeError) as error:
        if not folder.is_dir():
            raise _storage_error(path, _GONE, AGAIN) from error
        fault = _fault(error, folder)
        if fault is None:
            raise
        raise _storage_error(path, os.strerror(fault), _REMEDIES[fault]) from error
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def intact(path: Path, say: Callable[[str], object]) -> bool:
    """Whether a file is there that `writing(path, sealed=True)` left whole; a damaged one is removed.

    Args:
        path: of the file.
        say: called with a line where a file is removed.
    """
    try:
        status = path.lstat()
    except (FileNotFoundError, NotADirectoryError):
        return False
    size = status.st_size - _SEAL_BYTES
    if stat.S_ISREG(status.st_mode) and size >= 0 and _tail(path, size) == _SEAL + _sum(path, size):
        return True
    if not stat.S_ISDIR(status.st_mode):
        path.unlink()
    say(f"warning: {path} was damaged after it was written: left out, and its part of the work is done again")
    return False


def _tail(path: Path, start: int) -> bytes:
    with path.open("rb") as file:
        file.seek(start)
        return file.read()


def _sum(path: Path, size: int) -> bytes:
    """The sha256 in hex of the first `size` bytes of a file."""
    found, left = hashlib.sha256(), size
    with path.open("rb") as file:
        while left and (piece := file.read(min(_PIECE, left))):
            found.update(piece)
            left -= len(piece)
    return found.hexdigest().encode()


@contextmanager
def refusals(folder: Path) -> Iterator[None]:
    """Tell in one line that the disk refused a file below a folder, whoever wrote it.

    Raises:
        StorageError: no space, no permission or no writable file system.
    """
    try:
        yield
    except OSError as error:
        if error.errno not in _REMEDIES or (fault := _fault(error, folder)) is None:
            raise
        raise _storage_error(folder, os.strerror(fault), _REMEDIES[fault]) from error


def clear_partial(folder: Path) -> None:
    """Remove what killed processes left half-written below a folder that no other process writes to."""
    for left in folder.rglob(f"{_PARTIAL}*"):
        shutil.rmtree(left, ignore_errors=True)


@contextmanager
def locked(path: str | Path, waiting: Callable[[], object] | None = None) -> Iterator[bool]:
    """Hold a lock that one process has at a time; any thread of it may, and may again.

    The operating system frees the lock of a process that ended, however it ended; the file stays.

    Args:
        path: of the lock's file; missing folders are made.
        waiting: called once before waiting for another process; without it, nothing is waited for.

    Yields:
        Whether the lock is held; False only where another process has it and nothing is waited for.

    Raises:
        StorageError: the file cannot be made, or its folder was deleted meanwhile.
    """
    path = Path(path)
    lock = _lock(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        held = _acquired(lock, waiting)
    except FileNotFoundError as error:
        raise _storage_error(path, _GONE, AGAIN) from error
    except OSError as error:
        raise _storage_error(
            path, error.strerror or str(error), _REMEDIES.get(error.errno or 0, _ACCESS)
        ) from error
    try:
        yield held
    finally:
        if held:
            lock.release()


def in_use(path: str | Path) -> bool:
    """Whether a process, this one included, holds the lock of that file.

    Raises:
        StorageError: the file cannot be opened.
    """
    if _lock(Path(path)).is_locked:
        return True
    with locked(path) as free:
        return not free


def _lock(path: Path) -> FileLock:
    # One object a path, so that a second claim of the same process is no claim of another one.
    return FileLock(path, thread_local=False, is_singleton=True, poll_interval=_LOCK_SECONDS)


def _acquired(lock: FileLock, waiting: Callable[[], object] | None) -> bool:
    try:
        lock.acquire(blocking=False)
    except Timeout:
        if waiting is None:
            return False
        waiting()
        lock.acquire()
    return True


def write_text(path: str | Path, text: str) -> Path:
    """Write a text in UTF-8, whole or not at all, and give its path.

    Raises:
        StorageError: the file could not be written.
    """
    with writing(path) as partial:
        partial.write_text(text, encoding="utf-8")
    return Path(path)


def write_json(path: str | Path, value: Any) -> None:
    """Write `value` as JSON, whole or not at all.

    Raises:
        StorageError: the file could not be written.
        ValueError: a number is not finite, which JSON cannot hold.
    """
    write_text(path, json.dumps(value, indent=2, allow_nan=False) + "\n")


def require_folder(folder: str | Path) -> None:
    """Make a folder, or refuse one that takes no file, before the work whose results go there.

    Raises:
        StorageError: it cannot be made or written.
    """
    try:
        Path(folder).mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        raise _refused(Path(folder), error) from error


def require_space(path: str | Path, size: int) -> None:
    """Refuse to begin a file that its disk cannot hold.

    Args:
        path: the file to come; its folder exists.
        size: [byte] expected.

    Raises:
        StorageError: less than `size` is free.
    """
    free = shutil.disk_usage(Path(path).parent).free
    if size > free:
        fault = f"it needs {size / 2**20:.1f} MiB and the disk has {free / 2**20:.1f} MiB free"
        raise _storage_error(Path(path), fault, _SPACE)


def size_of(path: str | Path) -> int:
    """[byte] of a file, or of all files below a folder, but for those that are removed meanwhile."""
    path = Path(path)
    files = [path] if path.is_file() else (Path(at, name) for at, _, names in os.walk(path) for name in names)
    total = 0
    for file in files:
        with suppress(OSError):
            total += file.lstat().st_size
    return total


def bytes_text(count: float) -> str:
    """Bytes as a reader takes them in: 1.4 GiB."""
    power = min(4, int(math.log(max(count, 1), 1024)))
    return f"{count / 1024**power:.3g} {('B', 'KiB', 'MiB', 'GiB', 'TiB')[power]}"


def _flush(path: Path) -> None:
    # Quotas and network file systems may report a full disk no earlier than here.
    with path.open("rb") as file:
        os.fsync(file.fileno())


def _fault(error: OSError | RuntimeError, folder: Path) -> int | None:
    """The errno of a storage fault behind `error`; None for any other fault."""
    number = getattr(error, "errno", None)
    if number in _REMEDIES:
        filename = getattr(error, "filename", None)
        elsewhere = isinstance(filename, str) and folder not in Path(filename).parents
        return None if elsewhere else number
    context = error.__context__  # torch.save ends in an error of its own
    if isinstance(context, OSError | RuntimeError) and (fault := _fault(context, folder)):
        return fault
    # h5py wraps the cause into its own text, as OSError or RuntimeError.
    named = (number for number in _REMEDIES if os.strerror(number) in str(error))
    full = shutil.disk_usage(folder).free < _FULL_BYTES
    return next(named, errno.ENOSPC if full else None)


def _refused(path: Path, error: OSError) -> StorageError:
    stands_there = isinstance(error, FileExistsError | NotADirectoryError)
    remedy = _PLACE if stands_there else _REMEDIES.get(error.errno or 0, _ACCESS)
    return _storage_error(path, error.strerror or str(error), remedy)


def _storage_error(path: Path, fault: str, remedy: str) -> StorageError:
    return StorageError(f"cannot write {path}: {fault}; {remedy}")
