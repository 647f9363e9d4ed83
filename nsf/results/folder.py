"""A folder that is replaced whole or not at all."""

import re
import shutil
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from nsf.errors import ConfigError, StorageError
from nsf.storage import in_use, locked

MARK = "sources.json"
"""The file by which a folder is known as a report and may be replaced."""

_LEFT = re.compile(r"\.(?P<name>.+)\.(?P<kind>new|old)-\w+")  # beside a folder while it is replaced


def check_place(folder: Path) -> None:
    """Refuse a place where `replaced` could not put a report; the folder above it is made.

    Raises:
        ConfigError: `folder` holds something that is not a report.
        StorageError: the folder above it cannot be made or written.
    """
    folder = Path(folder).absolute()
    if folder.exists() and not (folder / MARK).is_file() and (not folder.is_dir() or any(folder.iterdir())):
        raise ConfigError(
            f"{folder} exists and is not a report (it has no {MARK}); name another folder or remove it"
        )
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder.parent).close()
    except OSError as error:
        raise _no_place(folder, error) from error


def _no_place(folder: Path, error: OSError) -> StorageError:
    return StorageError(
        f"no report can be written to {folder}: {error.strerror}; make the folder above it writable, or "
        "set report.folder or NSF_REPORTS"
    )


@contextmanager
def replaced(folder: Path) -> Iterator[Path]:
    """An empty sibling folder to write into; it takes `folder`'s place once the block ends without an error.

    Until then, and after any error or interrupt, whatever stood at `folder` stands there unchanged. Two
    processes that replace it do so in turn, by the lock `.<name>.lock` beside it, which stays; what a killed
    process left beside it is removed.

    Raises:
        ConfigError: `folder` holds something that is not a report.
        StorageError: the disk refused a file.
    """
    folder = Path(folder).absolute()
    check_place(folder)
    _clear(folder.parent)
    waiting = f"waiting for another process, which writes {folder}"
    with locked(_lock(folder), waiting=lambda: print(waiting, file=sys.stderr)):
        try:
            fresh = Path(tempfile.mkdtemp(prefix=f".{folder.name}.new-", dir=folder.parent))
        except OSError as error:
            raise _no_place(folder, error) from error
        try:
            yield fresh
            fresh.chmod(0o755)
            _take_place(fresh, folder)
        except OSError as error:
            raise StorageError(
                f"the report for {folder} was not written: {error}; the old one, if any, stands"
            ) from error
        finally:
            shutil.rmtree(fresh, ignore_errors=True)


def _lock(folder: Path) -> Path:
    """Its holder, and nobody else, has folders beside `folder` that are to replace it."""
    return folder.with_name(f".{folder.name}.lock")


def _clear(reports: Path) -> None:
    """Remove what killed processes left in a folder of reports; a report that was put aside comes back."""
    for left in sorted(reports.iterdir()):
        found = _LEFT.fullmatch(left.name)
        if not found:
            continue
        folder = reports / found["name"]
        with suppress(OSError, StorageError):  # of someone else
            if in_use(_lock(folder)):
                continue
            if found["kind"] == "old" and not folder.exists():
                left.rename(folder)
            shutil.rmtree(left, ignore_errors=True)


def _take_place(fresh: Path, folder: Path) -> None:
    if not folder.exists():
        fresh.rename(folder)
        return
    old = fresh.with_name(fresh.name.replace(".new-", ".old-"))
    folder.rename(old)
    try:
        fresh.rename(folder)
    except BaseException:
        old.rename(folder)
        raise
    shutil.rmtree(old)
