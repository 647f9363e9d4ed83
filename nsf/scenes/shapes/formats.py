"""Polygons from .obj, .ply and .stl files: geometry alone, read whole or not at all."""

import io
import re
import struct
import warnings
from array import array
from dataclasses import dataclass, field

import numpy as np

_BYTE_ORDER_MARK = b"\xef\xbb\xbf"
_UTF_16 = (b"\xff\xfe", b"\xfe\xff")
# Statements of an OBJ file that bring in a surface other than polygons.
_OTHER_SURFACES = (b"surf", b"call", b"csh")
_FACET = re.compile(
    rb"\s*facet\s+normal\s+\S+\s+\S+\s+\S+\s+outer\s+loop"
    + 3 * rb"\s+vertex\s+(\S+)\s+(\S+)\s+(\S+)"
    + rb"\s+endloop\s+endfacet(?=\s|$)",
    re.IGNORECASE,
)
_SOLID = re.compile(rb"^[ \t]*(end)?solid\b.*$", re.IGNORECASE | re.MULTILINE)
_STL = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_STL_HEAD = 84
_PLY_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
_PLY_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2",
    "ushort": "u2", "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "int64": "i8", "uint64": "u8", "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip


class MeshFileError(ValueError):
    """A file is not whole, or not of its format; the text goes on after the file's name."""


@dataclass(frozen=True)
class Polygons:
    """Faces of any number of corners.

    Attributes:
        vertices: [V, 3] in the file's unit.
        corners: [C] vertices of one face after the other, counted from 0; not checked.
        sizes: [F] number of corners of each face.
    """

    vertices: np.ndarray
    corners: np.ndarray
    sizes: np.ndarray


def read_polygons(content: bytes, extension: str) -> Polygons:
    """The polygons of a file with this content.

    Args:
        content: the file's bytes.
        extension: `.obj`, `.ply` or `.stl`.

    Raises:
        MeshFileError: the file is cut short, holds more than it counts, or is not of its format.
    """
    try:
        return {".obj": _obj, ".ply": _ply, ".stl": _stl}[extension](content)
    except (ValueError, OverflowError, struct.error) as error:
        if isinstance(error, MeshFileError):
            raise
        raise MeshFileError(f"cannot be read as {extension}: {error}") from error


def _text(content: bytes) -> bytes:
    """The content without a byte order mark, with a line feed at the end of each line."""
    if content.startswith(_UTF_16):
        raise MeshFileError("is text in UTF-16, and only UTF-8 is read")
    return content.removeprefix(_BYTE_ORDER_MARK).replace(b"\r\n", b"\n").replace(b"\r", b"\n")


def _obj(content: bytes) -> Polygons:
    """Wavefront OBJ: an index counts from 1, or where negative from the last vertex read so far."""
    vertices, corners, sizes = array("d"), array("q"), array("q")
    for number, line in enumerate(io.BytesIO(re.sub(rb"\\\n", b" ", _text(content))), 1):
        words = line.partition(b"#")[0].split()
        try:
            if not words:
                continue
            if words[0] == b"v":
                if len(words) < 4:
                    raise ValueError("a vertex has three coordinates")
                vertices.extend(map(_number, words[1:4]))
            elif words[0] in (b"f", b"fo"):
                face = _obj_face(words[1:], len(vertices) // 3)
                corners.extend(face)
                sizes.append(len(face))
            elif words[0] in _OTHER_SURFACES:
                raise MeshFileError(f"has `{words[0].decode()}`, and only polygons are read")
        except (ValueError, OverflowError) as error:
            if isinstance(error, MeshFileError):
                raise
            shown = line.strip()[:60].decode(errors="replace")
            raise MeshFileError(f"cannot be read at statement {number}, `{shown}`: {error}") from error
    return Polygons(*_arrays(vertices, corners, sizes))


def _number(word: bytes) -> float:
    """The value of a number as files write it: Python's own `1_000` is none."""
    if b"_" in word:
        raise ValueError(f"{word.decode(errors='replace')!r} is no number")
    return float(word)


def _obj_face(words: list[bytes], vertices: int) -> list[int]:
    """The vertices of a face from 0: of `7/2/5` the first, −1 the last of those read."""
    face = [int(word.partition(b"/")[0]) for word in words]
    if 0 in face or b"_" in b"".join(words):
        raise ValueError("a face names vertex 0, and OBJ counts from 1" if 0 in face else "no index")
    if min(face, default=0) < -vertices:
        raise ValueError(f"a face names vertex {min(face)}, of {vertices} read so far")
    return [vertices + i if i < 0 else i - 1 for i in face]


def _arrays(vertices: array, corners: array, sizes: array) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return np.array(vertices).reshape(-1, 3), np.array(corners, np.int64), np.array(sizes, np.int64)


def _stl(content: bytes) -> Polygons:
    """STL: binary where its length is what its count says, whatever its first word."""
    counted = struct.unpack_from("<I", content, 80)[0] if len(content) >= _STL_HEAD else None
    there, surplus = divmod(len(content) - _STL_HEAD, _STL.itemsize)
    if counted is not None and (there, surplus) == (counted, 0):
        corners = np.frombuffer(content, _STL, offset=_STL_HEAD)["corners"]
        return _triangles(corners.astype(float).reshape(-1, 3))
    if re.match(rb"\s*solid\b", content.removeprefix(_BYTE_ORDER_MARK), re.IGNORECASE):
        return _ascii_stl(_text(content))
    if counted is None:
        raise MeshFileError("is no STL: it neither begins with `solid` nor has a binary header")
    if counted > there:
        raise MeshFileError(f"is cut short: its header counts {counted} triangles, {there} are there")
    raise MeshFileError(
        f"has {len(content) - _STL_HEAD - counted * _STL.itemsize} bytes beyond the {counted} triangles "
        "that its header counts"
    )


def _ascii_stl(text: bytes) -> Polygons:
    ends = sum(1 for line in _SOLID.finditer(text) if line[1])
    body, vertices, at = _SOLID.sub(b"", text), array("d"), 0
    while facet := _FACET.match(body, at):
        vertices.extend(map(_number, facet.groups()))
        at = facet.end()
    rest = body[at:]
    whole = len(vertices) // 9
    if rest.strip() and re.search(rb"\bendfacet\b", rest, re.IGNORECASE):
        raise MeshFileError(f"cannot be read as .stl: facet {whole + 1} is not one loop of three vertices")
    if rest.strip() or not ends:
        raise MeshFileError(f"is cut short after {whole} triangles")
    return _triangles(np.array(vertices).reshape(-1, 3))


def _triangles(vertices: np.ndarray) -> Polygons:
    """Triangles of three vertices each."""
    return Polygons(vertices, np.arange(len(vertices)), np.full(len(vertices) // 3, 3))


@dataclass
class _Element:
    """An element of a PLY file: so many rows of named values, of which some are lists.

    Attributes:
        properties: (name, type of the length where it is a list, type), types as numpy names them.
    """

    name: str
    count: int
    properties: list[tuple[str, str | None, str]] = field(default_factory=list)


def _ply(content: bytes) -> Polygons:
    """PLY: text, or binary of either byte order; faces of any size, also mixed."""
    content = content.removeprefix(_BYTE_ORDER_MARK)
    kind, elements, start = _ply_header(content)
    body = content[start:]
    if kind == "ascii":
        # As a binary file of doubles, so that both are read alike.
        body = _doubles(body).tobytes()
        for element in elements:
            element.properties = [(name, size and "f8", "f8") for name, size, _ in element.properties]
    at, vertices, faces = 0, np.empty((0, 3)), (np.empty(0, np.int64), np.empty(0, np.int64))
    for element in elements:
        columns, at = _ply_rows(body, at, element, _PLY_ORDERS[kind])
        if element.name == "vertex":
            if not {"x", "y", "z"} <= columns.keys():
                raise MeshFileError("has vertices without x, y and z")
            vertices = np.stack([columns[axis].astype(float) for axis in "xyz"], 1)
        elif element.name == "face" and element.count:
            listed = [name for name in ("vertex_indices", "vertex_index") if name in columns]
            if not listed or not isinstance(columns[listed[0]], tuple):
                raise MeshFileError("has faces without a list `vertex_indices`")
            faces = tuple(_integers(values) for values in columns[listed[0]])
        elif element.name == "tristrips" and element.count:
            raise MeshFileError("has triangle strips, and only polygons are read")
    if body[at:].strip(b"\0 \t\r\n"):
        raise MeshFileError("has more rows than its header counts")
    return Polygons(vertices, *faces)


def _ply_header(content: bytes) -> tuple[str, list[_Element], int]:
    """The kind of the file, its elements, and where its rows begin."""
    first = re.match(rb"ply[ \t]*(\r\n|\n|\r)", content)
    if not first:
        raise MeshFileError("is no PLY: its first line is not `ply`")
    end = re.compile(re.escape(first[1]) + rb"end_header[ \t]*" + re.escape(first[1])).search(content)
    if not end:
        raise MeshFileError("is cut short: its header has no end")
    kind, elements = None, []
    for line in content[first.end() : end.start()].decode("utf-8", "replace").split(first[1].decode()):
        match line.split():
            case [] | ["comment" | "obj_info", *_]:
                pass
            case ["format", kind, _] if kind in _PLY_ORDERS:
                pass
            case ["element", name, count] if count.isascii() and count.isdigit():
                elements.append(_Element(name, int(count)))
            case ["property", "list", size, of, name] if elements and {size, of} <= _PLY_TYPES.keys():
                elements[-1].properties.append((name, _PLY_TYPES[size], _PLY_TYPES[of]))
            case ["property", of, name] if elements and of in _PLY_TYPES:
                elements[-1].properties.append((name, None, _PLY_TYPES[of]))
            case _:
                raise MeshFileError(f"cannot be read as .ply: its header has `{line.strip()[:60]}`")
    if kind not in _PLY_ORDERS:
        raise MeshFileError("cannot be read as .ply: its header names no format")
    return kind, elements, end.end()


def _doubles(text: bytes) -> np.ndarray:
    """All numbers of a text; unlike `numpy.fromstring` alone, or an error."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            return np.fromstring(_text(text), sep=" ")
        except (ValueError, DeprecationWarning):
            raise MeshFileError("cannot be read as .ply: its rows hold more than numbers") from None


def _integers(values: np.ndarray) -> np.ndarray:
    """The values as integers; ASCII files are read as doubles."""
    if values.dtype.kind == "f" and not (np.isfinite(values) & (values == np.floor(values))).all():
        raise MeshFileError("has an index that is no integer")
    # Beyond any number of vertices, and still an integer.
    return np.clip(values, -1, 2**40).astype(np.int64)


def _ply_rows(body: bytes, at: int, element: _Element, order: str) -> tuple[dict, int]:
    """Columns of an element from a place of the body, and where its rows end; a list as (values, lengths)."""
    if not element.properties or not element.count:
        return {}, at
    if len({name for name, *_ in element.properties}) < len(element.properties):
        raise MeshFileError(f"cannot be read as .ply: two properties of {element.name} have one name")
    lengths = {name: 0 for name, size, _ in element.properties if size}
    if lengths:
        lengths = _first_lengths(body, at, element, order)
    row = np.dtype([part for p in element.properties for part in _row_parts(p, lengths, order)])
    there = min(element.count, (len(body) - at) // row.itemsize)
    rows = np.frombuffer(body, row, there, at)
    differ = there < element.count or any((rows[f"{n}\n"] != length).any() for n, length in lengths.items())
    if lengths and differ:
        return _ply_mixed_rows(body, at, element, order)
    if differ:
        raise _cut_short(element, there)
    columns = {
        name: (rows[name].ravel(), np.full(there, lengths[name])) if size else rows[name]
        for name, size, _ in element.properties
    }
    return columns, at + there * row.itemsize


def _row_parts(of: tuple[str, str | None, str], lengths: dict[str, int], order: str) -> list[tuple]:
    """Fields of a property in a row whose lists have these lengths; no PLY name holds a line feed."""
    name, size, kind = of
    if size is None:
        return [(name, order + kind)]
    return [(f"{name}\n", order + size), (name, order + kind, (lengths[name],))]


def _first_lengths(body: bytes, at: int, element: _Element, order: str) -> dict[str, int]:
    """Lengths of the lists of an element's first row."""
    lengths = {}
    for name, size, kind in element.properties:
        if size:
            lengths[name] = _length(body, at, element, 0, order + size)
            at += np.dtype(size).itemsize
        at += lengths.get(name, 1) * np.dtype(kind).itemsize
    return lengths


def _length(body: bytes, at: int, element: _Element, row: int, kind: str) -> int:
    if at + np.dtype(kind).itemsize > len(body):
        raise _cut_short(element, row)
    length = np.frombuffer(body, kind, 1, at)[0]
    if not (0 <= length <= len(body) and length == int(length)):
        raise MeshFileError(f"has a list of {length} values in {element.name} {row}")
    return int(length)


def _ply_mixed_rows(body: bytes, at: int, element: _Element, order: str) -> tuple[dict, int]:
    """As `_ply_rows`, where the rows differ in length."""
    steps = [(n, s and order + s, order + k) for n, s, k in element.properties]
    values = {name: [] for name, size, _ in steps if size}
    for row in range(element.count):
        for name, size, kind in steps:
            length = 1
            if size:
                length = _length(body, at, element, row, size)
                at += np.dtype(size).itemsize
            end = at + length * np.dtype(kind).itemsize
            if end > len(body):
                raise _cut_short(element, row)
            if size:
                values[name].append(np.frombuffer(body, kind, length, at))
            at = end
    return {
        name: (np.concatenate(lists), np.array([len(v) for v in lists])) for name, lists in values.items()
    }, at


def _cut_short(element: _Element, there: int) -> MeshFileError:
    return MeshFileError(
        f"is cut short: its header counts {element.count} rows of {element.name}, {there} are there"
    )
