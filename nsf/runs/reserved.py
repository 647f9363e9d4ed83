"""Runs that a sweep, or a chain of stages, needs until it ends: nothing deletes them meanwhile."""

import uuid
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from nsf.errors import StorageError
from nsf.runs.run import Run
from nsf.storage import in_use, locked, write_text

_FOLDER = ".reserved"  # of a folder of runs: a list of ids and a lock for each living sweep
_OWN: set[Path] = set()  # lists of this process


@contextmanager
def reserving(runs: Iterable[Run]) -> Iterator[None]:
    """Reserve runs while the block works, for as long as this process lives.

    Raises:
        StorageError: the folder of runs cannot be written.
    """
    ids = {run.id: run.root for run in runs}
    if not ids:
        yield
        return
    names = next(iter(ids.values())) / _FOLDER / f"{uuid.uuid4().hex}.txt"
    lock = names.with_suffix(".lock")
    with locked(lock):
        try:
            write_text(names, "\n".join(ids))
            _OWN.add(names)
            yield
        finally:
            _OWN.discard(names)
            _forget(names)


def reserved(root: Path, by_others: bool = False) -> set[str]:
    """Ids of the runs below a folder of runs that living processes reserve.

    Args:
        root: folder of runs.
        by_others: without those of this process.
    """
    ids: set[str] = set()
    for names in (root / _FOLDER).glob("*.txt"):
        if by_others and names in _OWN:
            continue
        with suppress(OSError, StorageError):  # it has ended meanwhile, or is of someone else
            if in_use(names.with_suffix(".lock")):
                ids.update(names.read_text(encoding="utf-8", errors="replace").split("\n"))
            else:
                _forget(names)
    return ids


def _forget(names: Path) -> None:
    with suppress(OSError):
        names.unlink(missing_ok=True)
        names.with_suffix(".lock").unlink(missing_ok=True)
        names.parent.rmdir()
