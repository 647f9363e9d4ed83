"""Progress of long work for the user: a bar, or lines in a log, without chatter of libraries."""

import contextlib
import logging
import sys
import time
import warnings
from collections.abc import Iterator

from rich.progress import BarColumn, MofNCompleteColumn, ProgressColumn, Task, TextColumn, TimeRemainingColumn
from rich.progress import Progress as RichProgress
from rich.text import Text

from nsf.extras import COMMAND
from nsf.terminal import console

#: Between two lines of a log [s].
EVERY = 10.0


class _Rate(ProgressColumn):
    def __init__(self, unit: str):
        super().__init__()
        self._unit = unit

    def render(self, task: Task) -> Text:
        return Text(f"{self._unit}, {task.speed or 0:,.0f}/s,")


class Progress:
    """A progress bar on standard error; where that is a file, a line every ten seconds instead.

    Args:
        stage: name of the work.
        total: units of work.
        unit: name of the units.
    """

    def __init__(self, stage: str, total: int, unit: str):
        self._unit, self._total, self._done, self._what = unit, total, 0, stage
        self._logged = not sys.stderr.isatty()
        self._told, self._first = time.monotonic(), None  # (time, done) after the first work, which compiles
        self._bar = RichProgress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            _Rate(unit),
            TimeRemainingColumn(),
            TextColumn("left"),
            console=console(sys.stderr),
            disable=not sys.stderr.isatty(),
            transient=True,
        )
        self._stage = stage
        self._task = self._bar.add_task(stage, total=total)

    def __enter__(self) -> "Progress":
        self._bar.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self._bar.stop()

    def describe(self, what: str) -> None:
        """Name the present piece of work on the bar."""
        self._what = f"{self._stage}: {what}"
        self._bar.update(self._task, description=self._what)

    def advance(self, amount: int = 1) -> None:
        """Count work done."""
        self._bar.advance(self._task, amount)
        self._done += amount
        now = time.monotonic()
        self._first = self._first or (now, self._done)
        if self._logged and now - self._told >= EVERY:
            self._told, begun, before = now, *self._first
            rate = (self._done - before) / (now - begun) if self._done > before else 0.0
            left = f", {rate:,.1f}/s, {max(0, self._total - self._done) / rate:.0f} s left" if rate else ""
            line = f"{self._what}, {self._done:,} of {self._total:,} {self._unit}{left}"
            print(f"{label()}{line}", file=sys.stderr, flush=True)


_SECONDS: dict[str, float] = {}  # of this process's stages
START = "start"
"""Stands for a stage in `timed`: imports and, of a command, all before its first stage."""


@contextlib.contextmanager
def timed(stage: str) -> Iterator[None]:
    """Count the time of the block as that of a stage, and not as that of a block around it."""
    begun = time.monotonic()
    if COMMAND:
        _SECONDS.setdefault(START, begun - COMMAND[0])
    before = sum(_SECONDS.values())
    try:
        yield
    finally:
        within = sum(_SECONDS.values()) - before
        _SECONDS[stage] = _SECONDS.get(stage, 0.0) + time.monotonic() - begun - within


def seconds_of(stage: str) -> float:
    """The time that `timed` has counted for a stage of this process [s]."""
    return _SECONDS.get(stage, 0.0)


def slowest_stage() -> str:
    """The time of this process's stages, and the slowest: `41 s, of which simulate took 17 s`."""
    if not _SECONDS:
        return ""
    name = max(_SECONDS, key=_SECONDS.__getitem__)
    return f"{sum(_SECONDS.values()):.1f} s, of which {name} took {_SECONDS[name]:.1f} s"


_LABEL: list[str] = []  # of this process's job


def label() -> str:
    """The beginning of each line of this process; empty unless it is one of several side by side."""
    return f"[{_LABEL[-1]}] " if _LABEL and _LABEL[-1] else ""


@contextlib.contextmanager
def labelled(name: str) -> Iterator[None]:
    """Begin each line with the name of a job, while the block works."""
    _LABEL.append(name)
    try:
        yield
    finally:
        _LABEL.pop()


# What Lightning says about choices made on purpose here.
_EXPECTED_WARNINGS = (
    r".*GPU available but not used",
    r".*`isinstance\(treespec, LeafSpec\)` is deprecated",
    r".*does not have many workers",
    r".*The `srun` command is available on your system but is not used",
)


@contextlib.contextmanager
def quiet_lightning() -> Iterator[None]:
    """Silence Lightning's banner, and its warnings about choices that are made on purpose."""
    chatter = [logging.getLogger(name) for name in ("pytorch_lightning", "lightning_fabric")]
    levels = [logger.level for logger in chatter]
    for logger in chatter:
        logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            for message in _EXPECTED_WARNINGS:
                warnings.filterwarnings("ignore", message=message)
            yield
    finally:
        for logger, level in zip(chatter, levels, strict=True):
            logger.setLevel(level)
