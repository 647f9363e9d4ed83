"""HDF5 as it is read here: arrays that lie whole in the file itself, of the kind they should be.

A file may be made to read others (links and storage outside it), to claim more than it holds, or to run
filters. The writers of this package do none of that, so all of it is refused before anything is read.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

import h5py
import numpy as np

from nsf.data import heaps
from nsf.errors import MissingRunError, SchemaError, ShapeError
from nsf.manifest import verified

_LONGEST = 64  # [byte] of a text in an array of texts
#: On disk each text of an array is its length, and where it lies: 4 and 12 bytes (HDF5's "Global Heap ID").
_TEXT_BYTES = 16
_REFERENCE = np.dtype([("length", "<u4"), ("heap", "<u8"), ("index", "<u4")])
_OBJECTS = 16, 2**17  # of all heaps at most, for each text, and besides: one holds 65,535 at most
#: Errors of HDF5 on a file whose bytes are damaged.
_FAULTS = (OSError, RuntimeError, TypeError, ValueError, AttributeError, LookupError, ArithmeticError)


def opened(path: str | Path, what: str, stage: str) -> h5py.File:
    """A file opened for reading, once it is sure that nobody changed it after its run.

    Args:
        path: of the file.
        what: it should be, such as "trajectory".
        stage: that makes it.

    Raises:
        MissingRunError: there is no such file.
        SchemaError: it was changed after its run, is truncated, or is not HDF5.
    """
    try:
        return h5py.File(heaps.checked(verified(path)), "r")
    except FileNotFoundError as error:
        raise MissingRunError(f"no {what} at {path}; run `nsf {stage}` first") from error
    except OSError as error:
        raise SchemaError(f"{path} is truncated or not HDF5; {stage} again ({error})") from error


@contextmanager
def reading(path: str | Path, what: str, stage: str) -> Iterator[None]:
    """Any error in the block is a `SchemaError` that names the file and the command that makes it anew."""
    try:
        yield
    except KeyError as error:
        raise SchemaError(f"{path} lacks a part of a {what}; {stage} again ({error})") from error
    except (SchemaError, ShapeError) as error:
        remedy = "" if ";" in str(error) else f"; {stage} again"
        raise SchemaError(f"{path} {error}{remedy}") from error
    except _FAULTS as error:
        raise SchemaError(f"{path} is damaged; {stage} again ({error})") from error


def group(file: h5py.Group, name: str) -> h5py.Group:
    """A group or an array of a file that is reached by no link.

    Raises:
        KeyError: there is none.
        SchemaError: a link to somewhere else stands in its place.
    """
    node = file
    for part in name.split("/"):
        link = node.get(part, getlink=True) if isinstance(node, h5py.Group) else None
        if link is None:
            raise KeyError(name)
        if not isinstance(link, h5py.HardLink):
            raise SchemaError(f"has a link in the place of {name}")
        node = node[part]
    return node


def array(file: h5py.Group, name: str, types: Sequence[str], shape: Sequence[int | None]) -> h5py.Dataset:
    """An array that lies in one piece in the file.

    Args:
        file: or a group of it.
        name: within the group.
        types: which the values may be of, as "<f8"; "text" for texts of any length.
        shape: None for a size of any number but zero.

    Raises:
        KeyError: there is none.
        SchemaError: it is of another type or shape, lies elsewhere, or the file ends before it does.
    """
    dataset = group(file, name)
    if not isinstance(dataset, h5py.Dataset):
        raise SchemaError(f"has {name}, which is no array")
    has = () if dataset.shape is None else dataset.shape
    if len(has) != len(shape) or any(
        size != asked if asked is not None else not size for size, asked in zip(has, shape, strict=True)
    ):
        expected = ", ".join("any" if size is None else str(size) for size in shape)
        raise SchemaError(f"has {name} of shape {list(has)}, not [{expected}]")
    string = h5py.check_string_dtype(dataset.dtype)
    text = string is not None and string.length is None
    if ("text" if text else dataset.dtype) not in [t if t == "text" else np.dtype(t) for t in types]:
        raise SchemaError(f"has {name} of {dataset.dtype.str}, not {' or '.join(types)}")
    layout = dataset.id.get_create_plist()
    if layout.get_layout() != h5py.h5d.CONTIGUOUS or layout.get_external_count():
        packed = (
            f"packed by {dataset.compression}" if dataset.compression else "in chunks or outside the file"
        )
        raise SchemaError(f"has {name} {packed}, and not in one piece")
    needed = dataset.size * (_TEXT_BYTES if text else dataset.dtype.itemsize)
    held = dataset.id.get_storage_size()
    if held != needed or (needed and dataset.id.get_offset() + held > file.file.id.get_filesize()):
        raise SchemaError(f"ends before {name} does, which is of {needed:,} bytes")
    return dataset


def values(
    file: h5py.Group, name: str, types: Sequence[str], shape: Sequence[int | None], **limits: bool
) -> np.ndarray:
    """The values of an `array`, which are finite.

    Args:
        file, name, types, shape: as of `array`.
        limits: of `check`.

    Raises:
        KeyError, SchemaError: as of `array`, or the values are outside their limits.
    """
    data = array(file, name, types, shape)[()]
    check(name, data, **limits)
    return data


def check(name: str, data: np.ndarray | float, positive: bool = False, increasing: bool = False) -> None:
    """Refuse values that are not finite, or not positive or increasing where they have to be.

    Raises:
        SchemaError: names the array.
    """
    if not np.isfinite(data).all():
        raise SchemaError(f"has non-finite values of {name}")
    if positive and not np.all(np.asarray(data) > 0):
        raise SchemaError(f"has values of {name} that are not positive")
    if increasing and not np.all(np.diff(data) > 0):
        raise SchemaError(f"has {name} that does not increase")


def texts(file: h5py.Group, name: str, shape: Sequence[int | None]) -> list[str]:
    """The texts of an array, each of at most 64 bytes.

    Raises:
        KeyError, SchemaError: as of `array`, or a text is longer.
    """
    dataset = array(file, name, ["text"], shape)
    if not dataset.size:
        return []
    # HDF5 would give each as long as it claims to be, and walks a damaged heap of texts for ever.
    with open(file.file.filename, "rb") as raw:
        raw.seek(dataset.id.get_offset())
        references = np.frombuffer(raw.read(_TEXT_BYTES * dataset.size), _REFERENCE)
        if (longest := references["length"].max()) > _LONGEST:
            raise SchemaError(f"has {name} with a text of {longest} bytes")
        base = file.file.userblock_size
        heaps: dict[int, dict[int, int]] = {}
        read, objects = [], 0
        for length, heap, index in references.ravel().tolist():
            if length and heap not in heaps:
                heaps[heap] = _objects(raw, base + heap)
                objects += len(heaps[heap])
                if objects > _OBJECTS[0] * dataset.size + _OBJECTS[1]:
                    raise SchemaError(f"has {name} with texts in too many heaps")
            if length:
                raw.seek(heaps[heap][index])
            read.append(raw.read(length).decode())
    return read


def _objects(raw: BinaryIO, heap: int) -> dict[int, int]:
    """Where the objects of a heap lie in a file, by their index (HDF5's "Global Heap Collection")."""
    raw.seek(heap)
    head = raw.read(16)
    size = int.from_bytes(head[8:], "little") if head[:4] == b"GCOL" else 0
    places, at = {}, 16
    while at + 16 <= size:
        raw.seek(heap + at)
        head = raw.read(16)
        index = int.from_bytes(head[:2], "little")
        if not index or index in places:  # the rest is free; no index stands twice
            break
        places[index] = heap + at + 16
        at += 16 + -(-int.from_bytes(head[8:], "little") // 8) * 8
    return places


def attribute(file: h5py.File, name: str, kind: type) -> Any:
    """A single value beside the arrays.

    Args:
        file: whose attribute it is.
        name: of the attribute.
        kind: bool, int, float (which an int may stand for) or str.

    Raises:
        KeyError: there is none.
        SchemaError: it is of another kind, or not finite.
    """
    about = file.attrs.get_id(name)
    text = h5py.check_string_dtype(about.dtype) is not None
    letter = "O" if text else about.dtype.kind
    if about.shape != () or letter not in {bool: "b", int: "iu", float: "fiu", str: "O" * text}[kind]:
        raise SchemaError(f"has attribute {name}, which is no single {kind.__name__}")
    value = file.attrs[name]
    if kind is float:
        check(name, value)
    return value if kind is str else kind(value)
