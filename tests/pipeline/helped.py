"""The work of helping processes, in a module that they import at once."""

import os

from nsf.errors import InstabilityError
from nsf.pipeline.stages import cores


def count(number, advance, folder):
    """Three steps."""
    for _ in range(3):
        advance(1)
    return number, os.getpid(), cores.claimed(folder, 0)


def fail(number, advance, folder):
    """Nothing."""
    raise InstabilityError("it burst")


def fail_first(number, advance, folder):
    """Nothing, or steps without an end."""
    return go_on(number, advance, folder) if number else fail(number, advance, folder)


def go_on(number, advance, folder):
    """Steps without an end."""
    while True:
        advance(1)
