"""Archives as they are read here: tensors of `torch.save`, and arrays of `numpy.savez`.

A file may be made to run code, or to take a thousand times its size in memory. So its members are looked at
before anything is read, and its values before anything is made of them. All files of torch and NumPy are
opened here.
"""

import io
import math
import pickle
import pickletools
import re
import reprlib
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from nsf.errors import MissingRunError, SchemaError, first_line, out_of_memory
from nsf.manifest import verified
from nsf.schemas import Maybe
from nsf.storage import intact, writing

#: Errors of torch and of what is built from a file, on contents that are damaged or foreign.
FAULTS = (RuntimeError, LookupError, TypeError, AttributeError, ValueError, ArithmeticError)
_UNREADABLE = (
    *FAULTS, EOFError, OSError, AssertionError, pickle.UnpicklingError, zipfile.BadZipFile, zlib.error,
)  # fmt: skip
#: All that a pickle of plain data and tensors calls; torch allows 140 more, some of which claim memory.
_CALLED = re.compile(
    r"collections OrderedDict|torch \w+Storage|torch Size|torch._utils _rebuild_(tensor_v2|parameter)",
    re.ASCII,
)
_MOST_LEAVES = 100_000  # of what a file holds beside its tensors
_PLAIN = (str, int, float, bool, type(None))
#: Of a compressed archive: frames that rest come to a third of their size, a bomb to a thousandth.
_MOST_UNPACKED, _MOST_RATIO = 2**26, 8
_REPR = reprlib.Repr()
_REPR.maxstring = 100


def keep(path: Path, value: Any) -> None:
    """Write tensors and plain containers that a run which goes on after an interrupt shall find: see `kept`.

    Raises:
        StorageError: the disk refused the file.
    """
    import torch

    with writing(path, sealed=True) as partial, partial.open("wb") as file:
        torch.save(value, file)


def kept(path: Path, say: Callable[[str], object]) -> Any:
    """The content of a file of `keep`; None where there is none, or it was damaged since, which is said.

    Raises:
        SchemaError: somebody made the file.
    """
    if not intact(path, say):
        return None
    return tensors(path, "file of a run that was interrupted", "run")


@contextmanager
def taken_up(folder: Path, stage: str) -> Iterator[None]:
    """Content of `kept` that does not fit the work in the block is a `SchemaError` that names the folder."""
    try:
        yield
    except FAULTS as error:
        if out_of_memory(error):
            raise
        raise SchemaError(
            f"{folder} holds what no interrupted {stage} leaves ({first_line(error)}); delete the folder and "
            f"{stage} again"
        ) from error


def tensors(
    path: Path | str, what: str, stage: str, version: tuple[str, int] | None = None, mapped: bool = False
) -> Any:
    """The content of a file of `torch.save`, on the host: tensors in plain containers.

    Args:
        path: of the file.
        what: it should be, such as "checkpoint".
        stage: that makes it.
        version: of its content, a mapping that says so as `format` and `format_version`.
        mapped: leave values on disk until they are read.

    Raises:
        MissingRunError: there is no such file.
        SchemaError: it was changed after its run, is truncated, foreign, of another version, or holds more
            than such data.
    """
    import torch

    with _reading(path, what, stage):
        path = verified(path)
        try:
            _check_members(path)
            content = torch.load(path, map_location="cpu", weights_only=True, mmap=mapped)
            _check_plain(content, path.stat().st_size)
            if version is not None:
                _check_version(content, what, *version)
        except SchemaError as error:
            raise SchemaError(f"{path} {error}; {stage} again with `nsf {stage}`") from error
        return content


@contextmanager
def _reading(path: Path | str, what: str, stage: str) -> Iterator[None]:
    """Say of a file that is missing, truncated or foreign how it is made again."""
    try:
        yield
    except FileNotFoundError as error:
        raise MissingRunError(f"no {what} at {path}; run `nsf {stage}` first") from error
    except _UNREADABLE as error:
        raise SchemaError(
            f"{path} is truncated or no {what} ({first_line(error)}); delete it and run `nsf {stage}` again"
        ) from error


def _check_members(path: Path) -> None:
    """Raises SchemaError where a file would be larger in memory than on disk, or calls functions."""
    size, total = path.stat().st_size, 0
    with zipfile.ZipFile(path) as archive:
        for member in archive.infolist():
            total += member.file_size
            if member.compress_type != zipfile.ZIP_STORED or total > size:
                raise SchemaError("has a part that is compressed, or counts twice")
        for member in archive.infolist():
            if member.filename.endswith(".pkl") and (name := _foreign_call(archive.read(member))):
                raise SchemaError(f"calls {_REPR.repr(name)}, and no data do")


def _foreign_call(pickled: bytes) -> str | None:
    """The first name that a pickle looks up and plain data do not; None where there is none."""
    for operation, value, _ in pickletools.genops(pickled):
        known = operation.name == "GLOBAL" and _CALLED.fullmatch(value)
        if not known and operation.name in ("GLOBAL", "STACK_GLOBAL", "INST", "EXT1", "EXT2", "EXT4"):
            return value if isinstance(value, str) else operation.name
    return None


def _check_version(content: Any, what: str, name: str, number: int) -> None:
    if not isinstance(content, dict) or content.get("format") != name:
        raise SchemaError(f"is a torch file, but no {what} of nsf")
    if (version := content.get("format_version")) != number:
        raise SchemaError(f"has format_version {_REPR.repr(version)}, this nsf reads {number}")


def _check_plain(content: Any, size: int) -> None:
    """Raises SchemaError without the path where a value is of another kind than such files have."""
    import torch

    for leaf in leaves(content):
        if isinstance(leaf, torch.Tensor):
            plain = type(leaf) in (torch.Tensor, torch.nn.Parameter)
            if not plain or leaf.layout != torch.strided or leaf.device.type != "cpu":
                raise SchemaError("has a tensor that is none")
            if leaf.numel() * leaf.itemsize > size:
                raise SchemaError(f"has a tensor of {list(leaf.shape)}, which is larger than the file")
        elif not isinstance(leaf, _PLAIN):
            raise SchemaError(f"holds {_REPR.repr(leaf)}, which is no plain value")


def leaves(node: Any) -> Iterator[Any]:
    """Keys and values of a tree of containers.

    Raises:
        SchemaError: they are many, as where a list holds another one often, which takes no room in a file.
    """
    rest = [node]
    for _ in range(_MOST_LEAVES):
        if not rest:
            return
        node = rest.pop()
        if isinstance(node, dict | list | tuple):
            rest += [*node, *node.values()] if isinstance(node, dict) else node
        else:
            yield node
    raise SchemaError("holds more than plain data beside its tensors")


def arrays(
    path: Path | str, what: str, stage: str, layout: Mapping[str | Maybe, str] | None = None
) -> dict[str, np.ndarray]:
    """The arrays of a file of `numpy.savez`, by name.

    Args:
        path: of the file; what: it should be; stage: that makes it.
        layout: of each array that is read its kind (of NumPy) and axes, as "f frame particle 3": equal names
            are equal sizes of at least one, or of any with a star.

    Raises:
        MissingRunError: there is no such file.
        SchemaError: it was changed after its run, is truncated, foreign, holds objects, or takes far more
            memory than disk.
    """
    with _reading(path, what, stage):
        path = verified(path)
        most = max(_MOST_UNPACKED, _MOST_RATIO * path.stat().st_size)
        with zipfile.ZipFile(path) as archive:
            members = archive.infolist()
            if sum(member.file_size for member in members) > most:
                raise SchemaError(f"{path} takes more than {most:,} bytes; run `nsf {stage}` again")
            found = {m.filename.removesuffix(".npy"): _array(_unpacked(archive, m)) for m in members}
            _check_layout(found, layout or {})
            return found


def _check_layout(found: Mapping[str, np.ndarray], layout: Mapping[str | Maybe, str]) -> None:
    """Raises ValueError where an array is missing or not as its layout says."""
    sizes: dict[str, int] = {}
    for key, form in layout.items():
        name, (kind, *axes) = key.key if isinstance(key, Maybe) else key, form.split()
        if name not in found:
            if isinstance(key, Maybe):
                continue
            raise ValueError(f"it lacks {name}")
        values = found[name]
        fits = values.dtype.kind == kind and values.ndim == len(axes)
        for axis, size in zip(axes, values.shape, strict=False):
            known = int(axis) if axis.isdigit() else sizes.setdefault(axis, size)
            fits &= size == known and (size > 0 or axis.endswith("*"))
        if not fits:
            raise ValueError(
                f"it has {name} of {values.dtype.str}{list(values.shape)}, not [{', '.join(axes)}]"
            )
        if kind == "f" and not np.isfinite(values).all():
            raise ValueError(f"it has values of {name} that are not finite")


def _unpacked(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> bytes:
    """The bytes of a member, no more of them than it says, and with the sum that it says."""
    if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise ValueError(f"a part that is packed in the way {member.compress_type}")
    with archive.open(member) as stream:
        return stream.read(member.file_size)


def _array(data: bytes) -> np.ndarray:
    """An array from the bytes of an .npy file, of numbers or texts, in as much memory as it has bytes.

    Raises:
        ValueError: it is none, or its bytes are not those of its shape.
    """
    stream = io.BytesIO(data)
    version = np.lib.format.read_magic(stream)
    if version != (1, 0):
        raise ValueError(f"an array of format {version}")
    shape, by_columns, dtype = np.lib.format.read_array_header_1_0(stream)
    if dtype.kind not in "biufU":
        raise ValueError(f"an array of {dtype.str}")
    if math.prod(shape) * dtype.itemsize != len(data) - stream.tell():
        raise ValueError(f"an array of shape {list(shape)} in {len(data)} bytes")
    values = np.frombuffer(data, dtype, offset=stream.tell())
    return values.reshape(shape, order="F" if by_columns else "C").copy()  # which may be written to
