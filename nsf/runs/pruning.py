"""Runs that can go: those from which nothing complete was made, and which no sweep needs."""

import re
import shutil
from collections.abc import Iterable, Sequence
from contextlib import suppress
from datetime import UTC, datetime, timedelta
from pathlib import Path

from nsf.errors import ConfigError, StorageError
from nsf.runs.listing import Entry
from nsf.runs.reserved import reserved
from nsf.runs.run import Run

#: Stages whose complete runs are results: nothing is made from them, and they are why the rest was made.
RESULTS = ("evaluate", "superresolve")
_AGE = re.compile(r"(\d+(?:\.\d+)?)([hdw])")
_HOURS = {"h": 1, "d": 24, "w": 168}


def dependents(runs: Iterable[Run]) -> dict[Run, set[Run]]:
    """The complete or running runs that were made from each run, by themselves or through others."""
    runs = list(runs)
    needing: dict[Run, set[Run]] = {}
    for run in runs:
        if run.status not in ("complete", "running"):
            continue
        waiting, seen = list(run.parent_runs), set()
        while waiting:
            if (parent := waiting.pop()) not in seen:
                seen.add(parent)
                needing.setdefault(parent, set()).add(run)
                waiting += parent.parent_runs
    return needing


def prunable(entries: Sequence[Entry], everything: Sequence[Run], results: bool = False) -> list[Run]:
    """Of some runs, those that no complete run depends on, unless that one goes as well, and no sweep needs.

    Args:
        entries: the runs that may go.
        everything: all runs.
        results: complete runs of the last stages may go, too.
    """
    needed = set().union(*(reserved(root) for root in {run.root for run in everything}))
    candidates = [
        entry.run
        for entry in entries
        if entry.run.status != "running"
        and entry.run.id not in needed
        and (results or not _is_result(entry.run))
    ]
    of = dependents(everything)
    while True:
        going = set(candidates)
        left = [run for run in candidates if of.get(run, set()) <= going]
        if len(left) == len(candidates):
            return left
        candidates = left


def _is_result(run: Run) -> bool:
    return run.stage in RESULTS and run.status == "complete"


def older(entries: Iterable[Entry], age: str) -> list[Entry]:
    """The runs that were begun longer ago than an age, as 36h, 7d or 2w.

    Raises:
        ConfigError: it is no age.
    """
    if not (match := _AGE.fullmatch(age)):
        raise ConfigError(f"older={age} is no age; give hours, days or weeks, as 36h, 7d or 2w")
    before = datetime.now(UTC) - timedelta(hours=float(match[1]) * _HOURS[match[2]])
    return [e for e in entries if (at := e.values["created"]) and datetime.fromisoformat(at) < before]


def remove(run: Run) -> None:
    """Delete a run's folder, and those above it that this leaves empty.

    Raises:
        StorageError: a process is making the run or needs it, or the folder cannot be deleted.
    """
    making = StorageError(f"{run.id} is being made by another process; wait until it has ended")
    if run.status == "running":
        raise making
    if run.id in reserved(run.root):
        raise StorageError(f"{run.id} is needed by a sweep that is running; wait until it has ended")
    with run.claimed() as claimed:
        if not claimed:
            raise making
        aside = run.path.with_name(f".{run.hash}.removed")  # no one is to see a run that is half gone
        try:
            shutil.rmtree(aside, ignore_errors=True)
            run.path.rename(aside)
            shutil.rmtree(aside)
        except OSError as error:
            raise StorageError(f"{run.path} cannot be deleted: {error.strerror}") from error
    _drop_empty(run.path.parent, run.root)


def _drop_empty(folder: Path, root: Path) -> None:
    with suppress(OSError):
        while folder != root:
            folder.rmdir()
            folder = folder.parent
