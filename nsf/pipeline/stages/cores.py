"""Helping processes, a core each, which share full-order runs on a CPU."""

import contextlib
import importlib
import os
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_EXCEPTION, Future, wait
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from joblib.externals.loky import ProcessPoolExecutor, cpu_count

from nsf.memory import host_memory

_POLL = 0.05  # [s] between looks at how far the helpers have come
_STEPS = "steps"  # file of these
#: Steps of particles, some seconds of them, from which on other processes are worth their start.
_WORTH = 1_000_000

Advance = Callable[[int], object]
"""Counts steps done; ends the work of a process that should stop."""


def cores(device: str) -> int:
    """Cores for runs on a device: one for those on a GPU.

    Where OMP_NUM_THREADS is set, as by a launcher of jobs side by side, there are no more than it says.
    """
    if device != "cpu":
        return 1
    threads = os.environ.get("OMP_NUM_THREADS", "").partition(",")[0]  # "4,2" has those of each level
    return min(cpu_count(), int(threads)) if threads.isdigit() and int(threads) else cpu_count()


def helper_count(device: str, scenes: Sequence, nbytes: int) -> int:
    """How many helping processes are worth their start, one for each further core at most.

    Args:
        device: of the runs.
        scenes: of each run.
        nbytes: [byte] that a run takes.
    """
    work = sum(scene.steps * scene.particle_count for scene in scenes)
    if work <= _WORTH:
        return 0
    return max(1, min(cores(device), len(scenes), host_memory() // max(1, nbytes))) - 1


class Helpers:
    """The helping processes; without any, this one does all.

    Args:
        folder: that all map their steps in, and claim runs in.
        futures: of their work.
        advance: counts their steps here.
    """

    def __init__(self, folder: Path, futures: Sequence[Future], advance: Advance):
        self.folder, self._futures, self._advance, self._counted = folder, futures, advance, 0

    def look(self) -> None:
        """Count their steps up to now."""
        if self._futures and (done := int(_steps_in(self.folder)[:-1].sum())) > self._counted:
            self._advance(done - self._counted)
            self._counted = done

    def results(self) -> list:
        """The result of each, once all have ended.

        Raises:
            Exception: the first one that ended the work of a process, at once.
        """
        while wait(self._futures, _POLL, FIRST_EXCEPTION).not_done:
            self.look()
            for future in self._futures:
                if future.done():
                    future.result()
        self.look()
        return [future.result() for future in self._futures]


@contextlib.contextmanager
def ahead(count: int, module: str) -> Iterator[ProcessPoolExecutor | None]:
    """Start processes for `helping`, which import a module while the block prepares; None for none."""
    pool = _processes(count, module) if count else None
    try:
        if pool:
            pool.submit(int)  # starts all
        yield pool
    finally:
        if pool:
            pool.shutdown(kill_workers=True)  # `helping` has waited for those with work


def _processes(count: int, module: str = __name__) -> ProcessPoolExecutor:
    return ProcessPoolExecutor(count, initializer=_begin, initargs=(module,), env={"OMP_NUM_THREADS": "1"})


@contextlib.contextmanager
def helping(
    work: Callable[[int, Advance, Path], object],
    count: int,
    advance: Advance,
    pool: ProcessPoolExecutor | None = None,
) -> Iterator[Helpers]:
    """Let other processes work while the block does; each has one thread.

    Results do not depend on how many there are if they share out runs, and not parts of them.

    Args:
        work: of a process, by its number, what counts its steps and the folder of `claim`; importable.
        count: of the processes; 0 for none.
        advance: counts their steps here.
        pool: of as many processes or more, started `ahead`; new ones by default.
    """
    with TemporaryDirectory(prefix="nsf-") as name:
        folder = Path(name)
        if not count:
            yield Helpers(folder, (), advance)
            return
        np.zeros(count + 1, np.int64).tofile(folder / _STEPS)  # the last one tells all to stop
        pool = pool or _processes(count)
        try:
            futures = [pool.submit(_work, work, number, folder) for number in range(count)]
            yield Helpers(folder, futures, advance)
        finally:
            _steps_in(folder)[-1] = 1
            pool.shutdown()


def claimed(folder: Path, run: int) -> bool:
    """Whether a run, by its number, is for this process: no helper was before it."""
    try:
        (folder / f"{run}").touch(exist_ok=False)
    except FileExistsError:
        return False
    return True


def _begin(module: str) -> None:
    """A helper leaves interrupts to the process that it helps, and imports what it will need."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    importlib.import_module(module)


def _work(work: Callable[[int, Advance, Path], object], number: int, folder: Path) -> object:
    steps = _steps_in(folder)

    def advance(amount: int = 1) -> None:
        steps[number] += amount
        if steps[-1]:
            raise KeyboardInterrupt

    return work(number, advance, folder)


def _steps_in(folder: Path) -> np.memmap:
    return np.memmap(folder / _STEPS, np.int64, "r+")
