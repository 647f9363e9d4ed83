"""Python processes beside this one, each of which makes one call and tells how far it has come.

They are fresh interpreters and no forks, since a fork of a process that has used a GPU cannot use one. Unlike
those of `multiprocessing`, they do not import the program that starts them: a script needs no guard.
"""

import contextlib
import os
import pickle
import signal
import subprocess
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from multiprocessing import Pipe
from multiprocessing.connection import Connection, wait
from typing import Any

from nsf.errors import LaunchError, NSFError

_GRACE = 10.0  # [s] for a process that is stopped to leave nothing half-written

#: What a worker is asked for: it may tell amounts of work done, and its value is the worker's result.
Call = Callable[[Callable[[int], None]], Any]


class Worker:
    """A process that makes one call.

    Args:
        call: made with a function that tells this process an amount of work done; all of it, and its result,
            are pickled.
        environment: set in the process before it starts, beside what this one has.
    """

    def __init__(self, call: Call, environment: Mapping[str, str]):
        self._connection, theirs = Pipe()
        code = f"import sys; sys.path[:] = {sys.path!r}; import nsf.workers as w; w.serve({theirs.fileno()})"
        with theirs:
            self._process = subprocess.Popen(
                [sys.executable, "-c", code],
                env={**os.environ, **environment},
                pass_fds=[theirs.fileno()],
                stdin=subprocess.DEVNULL,
                start_new_session=True,  # Ctrl-C is for this process, which then stops the other
            )
        with contextlib.suppress(BrokenPipeError):  # it died; `ended` says so
            self._connection.send_bytes(pickle.dumps(call))

    def fileno(self) -> int:
        """For `wait`."""
        return self._connection.fileno()

    def receive(self) -> tuple[str, Any]:
        """What it says next: ("told", amount), ("done", result) or ("failed", error)."""
        try:
            return pickle.loads(self._connection.recv_bytes())
        except (EOFError, OSError):
            code = self._process.wait()
            return "failed", LaunchError(f"a process beside this one ended with code {code} before its work")

    def stop(self) -> None:
        """Have it stop, as by Ctrl-C."""
        self._process.terminate()

    def join(self) -> None:
        """Wait until it has ended, which it is made to after a while."""
        try:
            self._process.wait(_GRACE)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


@contextmanager
def working(calls: Sequence[Call], environments: Sequence[Mapping[str, str]]) -> Iterator[list[Worker]]:
    """A worker for each call; those that are still at work when the block ends are stopped.

    Args:
        calls: see `Worker`.
        environments: of each.
    """
    workers: list[Worker] = []
    try:
        for call, environment in zip(calls, environments, strict=True):
            workers.append(Worker(call, environment))
        yield workers
    finally:
        for worker in workers:
            worker.stop()
        for worker in workers:
            worker.join()


def ended(
    workers: Sequence[Worker], told: Callable[[int], object] = lambda amount: None
) -> Iterator[tuple[Worker, Any]]:
    """Each worker with its result, or the error that it raised, in the order in which they end.

    Args:
        workers: at work.
        told: called with every amount that one of them tells.

    Yields:
        An error that is no `NSFError` becomes a `LaunchError`; its traceback is on standard error.
    """
    busy = list(workers)
    while busy:
        for worker in wait(busy):
            kind, value = worker.receive()
            if kind == "told":
                told(value)
            else:
                busy.remove(worker)
                yield worker, value


def results(workers: Sequence[Worker]) -> list[Any]:
    """The results of all, in order.

    Raises:
        NSFError: what the first one to fail raised.
        LaunchError: one died.
    """
    found = {}
    for worker, outcome in ended(workers):
        if isinstance(outcome, BaseException):
            raise outcome
        found[worker] = outcome
    return [found[worker] for worker in workers]


def serve(number: int) -> None:
    """What the process of a worker does.

    Args:
        number: of the open file that leads to the process that started it.
    """
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    connection = Connection(number)

    def say(kind: str, value: Any) -> None:
        connection.send_bytes(pickle.dumps((kind, value)))

    try:
        call = pickle.loads(connection.recv_bytes())
        threading.Thread(target=_end_with, args=(connection,), daemon=True).start()
        last = "done", call(lambda amount: say("told", amount))
    except KeyboardInterrupt:
        sys.exit(130)
    except NSFError as error:
        last = "failed", error
    except Exception as error:
        traceback.print_exc()
        last = "failed", LaunchError(f"{type(error).__name__}: {error}")
    # Told to stop from here on, it has nothing left to do; and what tidies up at the end of Python, as
    # torch's processes do among themselves, could wait for another process that has failed.
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    say(*last)
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(0)


def _end_with(connection: Connection) -> None:
    """End this process once the one that started it has ended, which says nothing more after the call."""
    connection.poll(None)
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(_GRACE)
    os._exit(1)
