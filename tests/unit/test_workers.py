"""Processes beside this one: results, errors, what is told, and that none outlives who started it."""

import os
import signal
import subprocess
import sys
import time
from functools import partial

import pytest

from nsf.errors import InstabilityError, LaunchError
from nsf.workers import ended, results, working


def doubled(number, tell):
    for _ in range(3):
        tell(number)
    return 2 * number, os.environ["NSF_TEST_NAME"]


def raises(error, tell):
    raise error


def dies(tell):
    os.kill(os.getpid(), signal.SIGKILL)


def waits(path, tell):
    """Say in a file who is at work, and how it ended."""
    path.write_text(str(os.getpid()))
    try:
        tell(1)
        time.sleep(60)
    except KeyboardInterrupt:
        path.write_text("interrupted")
        raise


def outcomes(*calls):
    with working(calls, [{"NSF_TEST_NAME": str(i)} for i in range(len(calls))]) as workers:
        found = dict(ended(workers))
        return [found[worker] for worker in workers]


def test_results_environments_and_what_is_told():
    told = []
    calls = [partial(doubled, 4), partial(doubled, 5)]
    with working(calls, [{"NSF_TEST_NAME": "a"}, {"NSF_TEST_NAME": "b"}]) as workers:
        found = dict(ended(workers, told.append))
    assert [found[worker] for worker in workers] == [(8, "a"), (10, "b")]
    assert sorted(told) == [4, 4, 4, 5, 5, 5]


def test_errors_cross_and_are_of_their_kind(capfd):
    own, foreign, dead = outcomes(
        partial(raises, InstabilityError("choose a smaller dt")), partial(raises, ValueError("no")), dies
    )
    assert isinstance(own, InstabilityError)
    assert str(own) == "choose a smaller dt"
    assert isinstance(foreign, LaunchError)
    assert str(foreign) == "ValueError: no"
    assert isinstance(dead, LaunchError)
    assert "code -9" in str(dead)
    assert capfd.readouterr().err.count("Traceback") == 1


def test_an_error_here_interrupts_them(tmp_path):
    path = tmp_path / "state"

    def fail(amount):
        raise RuntimeError("enough")

    with pytest.raises(RuntimeError, match="enough"), working([partial(waits, path)], [{}]) as workers:
        list(ended(workers, fail))
    assert path.read_text() == "interrupted"


_PROGRAM = """
import sys
from pathlib import Path
from functools import partial
sys.path.insert(0, {tests!r})
from test_workers import waits
from nsf.workers import ended, results, working
with working([partial(waits, Path({path!r}))], [{{}}]) as workers:
    list(ended(workers, lambda amount: print("at work", flush=True)))
"""


def test_none_outlives_a_killed_program(tmp_path):
    """The program has no guard against being imported again, which it need not have."""
    path = tmp_path / "state"
    code = _PROGRAM.format(tests=os.path.dirname(__file__), path=str(path))
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as program:
        assert program.stdout.readline() == "at work\n"
        program.kill()
    began = time.monotonic()
    while path.read_text() != "interrupted" and time.monotonic() - began < 20:
        time.sleep(0.05)
    assert path.read_text() == "interrupted"


def test_results_are_in_order_and_an_error_is_raised():
    environments = 2 * [{"NSF_TEST_NAME": "one"}]
    with working([partial(doubled, 1), partial(doubled, 2)], environments) as workers:
        assert results(workers) == [(2, "one"), (4, "one")]
    calls = [partial(doubled, 1), partial(raises, InstabilityError("it left the grid"))]
    with working(calls, environments) as workers, pytest.raises(InstabilityError, match="left the grid"):
        results(workers)
