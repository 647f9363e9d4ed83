"""Heaps of an HDF5 file, in which texts and names lie: whether a reader of them comes to an end.

HDF5 walks the objects of a heap of texts ("Global Heap Collection"), and the free places of a heap of names
("Local Heap"). In a damaged file an object may have no size, and a free place may lead back to itself: HDF5
then walks for ever, or until the memory is full. So heaps are walked here before HDF5 opens a file.
"""

import struct
from collections.abc import Iterator
from mmap import ACCESS_READ, mmap
from pathlib import Path

from nsf.errors import SchemaError
from nsf.manifest import once

_SIGNATURE = b"\x89HDF\r\n\x1a\n"
#: Objects and free places of all heaps, at most: a million texts are observed at most.
_MOST_PLACES = 2**21
_LAST = 1  # stands for the place after the last free one


def checked(path: str | Path) -> Path:
    """The path of a file whose heaps end; a file that is not HDF5 is left to HDF5.

    The file is read once a process, at twice the speed of its sha256.

    Raises:
        SchemaError: a heap has no end, or addresses are not of 8 bytes.
    """
    path = Path(path)
    once(_check, path, path.stat())
    return path


def _check(path: Path) -> None:
    if path.stat().st_size < len(_SIGNATURE):
        return
    with path.open("rb") as file, mmap(file.fileno(), 0, access=ACCESS_READ) as data:
        base = _start(data)
        if base is None:
            return
        at = base + (13 if data[base + 8 : base + 9] < b"\x02" else 9)
        if data[at : at + 2] not in (b"\x08\x08", b"\x08", b""):  # or cut short there
            raise SchemaError(f"{path} has addresses that are not of 8 bytes; write it again")
        places = 0
        for heap in _found(data, b"GCOL\x01"):
            places += _walked(path, _objects(data, heap), _MOST_PLACES - places)
        for heap in _found(data, b"HEAP\0"):
            places += _walked(path, _free(data, base, heap), _MOST_PLACES - places)


def _start(data: mmap) -> int | None:
    """Where HDF5 begins in a file: at 0, or at 512 or a doubling of it."""
    at = 0
    while at < len(data):
        if data[at : at + 8] == _SIGNATURE:
            return at
        at = max(512, 2 * at)
    return None


def _found(data: mmap, mark: bytes) -> Iterator[int]:
    """Where a mark stands, in rising order."""
    at = data.find(mark)
    while at >= 0:
        yield at
        at = data.find(mark, at + 1)


def _walked(path: Path, walk: Iterator[int], most: int) -> int:
    """How many places a heap has.

    Raises:
        SchemaError: the walk comes to a place again, or passes too many.
    """
    seen = set()
    for place in walk:
        if place in seen or len(seen) == most:
            raise SchemaError(f"{path} has a heap of texts or names without an end; write it again")
        seen.add(place)
    return len(seen)


def _objects(data: mmap, heap: int) -> Iterator[int]:
    """Places of the objects of a heap of texts, until HDF5 comes to its end or refuses it."""
    at, end = heap + 16, heap + _number(data, heap + 8)
    while at + 16 <= end <= len(data):
        yield at
        (index,), size = struct.unpack_from("<H", data, at), _number(data, at + 8)
        at += 16 + -(-size // 8) * 8 if index else size  # the free rest has its head in its size
        at %= 2**64  # as addresses do


def _free(data: mmap, base: int, heap: int) -> Iterator[int]:
    """Free places of a heap of names, until HDF5 comes to the last or refuses one."""
    size, place, segment = (_number(data, heap + at) for at in (8, 16, 24))
    while place != _LAST and place + 16 <= size and base + segment + size <= len(data):
        yield place
        place = _number(data, base + segment + place)


def _number(data: mmap, at: int) -> int:
    """The number of 8 bytes at a place; 0 where the file ends before."""
    return int.from_bytes(data[at : at + 8], "little")
