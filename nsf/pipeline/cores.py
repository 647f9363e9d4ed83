"""Processes beside this one, a core each: they share full-order runs on a CPU."""

import contextlib
import os
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from joblib.externals.loky import ProcessPoolExecutor, cpu_count

_POLL = 0.05  # [s] between looks at how far the others have come

Advance = Callable[[int], object]
"""Counts steps done; ends the work of a process that should stop."""


def cores(device: str) -> int:
    """Cores for runs on a device: one for those on a GPU.

    Where OMP_NUM_THREADS is set, as by a launcher of jobs side by side, there are no more than it says.
    """
    if device != "cpu":
        return 1
    threads = os.environ.get("OMP_NUM_THREADS", "")
    return min(cpu_count(), int(threads)) if threads.isdigit() and int(threads) else cpu_count()


@contextlib.contextmanager
def beside(work: Callable[[int, Advance], object], count: int, advance: Advance) -> Iterator[Callable]:
    """Let other processes work while the block does; each has one thread.

    Results do not depend on how many there are if the work of each shares out runs, and not parts of them.

    Args:
        work: of a process, by its number and with what counts its steps; importable, as are its arguments.
        count: of the processes; 0 for none.
        advance: counts their steps here.

    Yields:
        A call that counts the steps of the others up to now; with `wait=True` it waits for their end, and
        gives the result of each.

    Raises:
        Exception: the first one that ended the work of a process, where it is waited for.
    """
    if not count:
        yield lambda wait=False: []
        return
    with TemporaryDirectory(prefix="nsf-") as folder:
        path, counted = Path(folder) / "steps", 0
        np.zeros(count + 1, np.int64).tofile(path)  # the last one tells all to stop
        steps = np.memmap(path, np.int64, "r+")
        pool = ProcessPoolExecutor(count, initializer=_begin, env={"OMP_NUM_THREADS": "1"})
        futures = [pool.submit(_work, work, number, path) for number in range(count)]

        def look(wait: bool = False) -> list:
            nonlocal counted
            while True:
                ended = all(future.done() for future in futures)
                done = int(steps[:-1].sum())
                if done > counted:
                    advance(done - counted)
                    counted = done
                if ended or not wait:
                    return [future.result() for future in futures] if wait else []
                time.sleep(_POLL)

        try:
            yield look
        finally:
            steps[-1] = 1
            pool.shutdown()


def _begin() -> None:
    """A process beside another leaves interrupts to that."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _work(work: Callable[[int, Advance], object], number: int, path: Path) -> object:
    steps = np.memmap(path, np.int64, "r+")

    def advance(amount: int = 1) -> None:
        steps[number] += amount
        if steps[-1]:
            raise KeyboardInterrupt

    return work(number, advance)
