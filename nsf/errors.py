"""Every error the package raises on purpose.

Library code raises one of these; only the command line exits (with code 2).
Each message quotes the offending value and says what to do about it.
"""

import difflib
from collections.abc import Iterable
from typing import ClassVar


class NSFError(Exception):
    """Base class: a fault the user can mend; its text names the remedy.

    It is one line, also where it quotes a value that has several, or that would steer a terminal.
    """

    _kept: ClassVar[str] = ""  # characters beside visible ones

    def __init__(self, text: str = ""):
        visible = (c if c.isprintable() or c in self._kept else repr(c)[1:-1] for c in str(text))
        super().__init__("".join(visible))


class ConfigError(NSFError):
    """A key is unknown, missing, or has a value outside its valid range."""


class ShapeError(NSFError):
    """Arrays disagree in shape, particle number or particle identity."""


class SchemaError(NSFError):
    """A file is truncated, foreign, of a newer schema, or for other particles."""


class StorageError(NSFError):
    """A file could not be written: no space, no permission."""


class DeviceError(NSFError):
    """A device was asked for that this machine does not have."""


class InstabilityError(NSFError):
    """A time step is unstable, or particles left the domain or became non-finite."""


class ProjectionError(NSFError):
    """The latent projection is ill-posed or diverged."""


class MissingExtraError(NSFError):
    """A library that only some users need is not installed."""


class MissingRunError(NSFError):
    """A stage needs the result of an earlier stage that does not exist; lists those there are."""

    _kept = "\n"


class LaunchError(NSFError):
    """The jobs of a sweep could not be started: a program or a queue is missing."""


def first_line(error: BaseException) -> str:
    """The first line of what an error says; its kind where it says nothing."""
    return (str(error).splitlines() or [type(error).__name__])[0]


def unknown(key: str, keys: Iterable[str], taker: str = "") -> str:
    """A message that names a dotted key that there is not, and the nearest one, or those next to it.

    Args:
        key: that nothing reads; keys: those that are read.
        taker: the class that does not take the key.
    """
    head = f"unknown key {key!r}{f' of {taker}' if taker else ''}"
    parent, _, last = key.rpartition(".")
    keys = [other for other in keys if not key.startswith(f"{other}.")]
    beside = {other.rpartition(".")[2]: other for other in keys if other.rpartition(".")[0] == parent}
    near = [beside[name] for name in difflib.get_close_matches(last, beside, n=1)]
    same_end = [other for other in keys if other.rpartition(".")[2] == last]
    near = near or difflib.get_close_matches(key, same_end, n=1, cutoff=0.0)
    if not near and parent and beside:
        return f"{head}; {parent} has {', '.join(beside)}"
    near = near or difflib.get_close_matches(key, keys, n=1)
    return f"{head}; {f'did you mean {near[0]}?' if near else 'see `nsf run --help` for the groups'}"


# How libraries say that memory ran out, or that a limit on it, as `ulimit -v`, was met.
_OUT_OF_MEMORY = ("failed to map segment", "cannot allocate memory", "can't allocate memory", "out of memory")


def out_of_memory(error: BaseException | None) -> bool:
    """Whether an error, or one that it came from, is of memory that was not there."""
    if error is None or isinstance(error, MemoryError):
        return error is not None
    text = str(error).lower()
    return any(words in text for words in _OUT_OF_MEMORY) or out_of_memory(error.__cause__)
