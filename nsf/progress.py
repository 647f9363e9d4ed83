"""Progress of long work for the user: a bar with a rate and an end time, without chatter of libraries."""

import contextlib
import logging
import sys
import time
import warnings
from collections.abc import Callable, Iterator

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, ProgressColumn, Task, TextColumn, TimeRemainingColumn
from rich.progress import Progress as RichProgress
from rich.text import Text

_TOLD_SECONDS = 0.1  # between two messages to another process


class _Rate(ProgressColumn):
    def __init__(self, unit: str):
        super().__init__()
        self._unit = unit

    def render(self, task: Task) -> Text:
        return Text(f"{self._unit}, {task.speed or 0:,.0f}/s,")


class Progress:
    """A progress bar on standard error.

    Args:
        stage: name of the work.
        total: units of work.
        unit: name of the units.
        shown: whether this process shows the bar.
    """

    def __init__(self, stage: str, total: int, unit: str, shown: bool = True):
        self._bar = RichProgress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            _Rate(unit),
            TimeRemainingColumn(),
            TextColumn("left"),
            console=Console(stderr=True),
            disable=not (shown and sys.stderr.isatty()),
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
        self._bar.update(self._task, description=f"{self._stage}: {what}")

    def advance(self, amount: int = 1) -> None:
        """Count work done."""
        self._bar.advance(self._task, amount)


class Told:
    """Progress that another process shows: it tells that process the work done, some times a second.

    Args:
        tell: called with an amount of work.
    """

    def __init__(self, tell: Callable[[int], object]):
        self._tell, self._amount, self._since = tell, 0, time.monotonic()

    def __enter__(self) -> "Told":
        return self

    def __exit__(self, *exception: object) -> None:
        self._tell(self._amount)

    def describe(self, what: str) -> None:
        """Do nothing: the bar is for several pieces of work at once."""

    def advance(self, amount: int = 1) -> None:
        """Count work done."""
        self._amount += amount
        if time.monotonic() - self._since > _TOLD_SECONDS:
            self._tell(self._amount)
            self._amount, self._since = 0, time.monotonic()


# Lightning's remarks on choices that are made on purpose here.
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
