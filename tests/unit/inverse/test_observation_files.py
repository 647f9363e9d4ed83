"""Files of observations that are damaged, too large, compressed, or say more than is read."""

import bz2
import gzip
import io
import zipfile
from contextlib import suppress
from types import SimpleNamespace

import h5py
import numpy as np
import pytest
import torch

from nsf.errors import NSFError
from nsf.inverse import columns
from nsf.inverse.observations import Observations

MODEL = SimpleNamespace(t=np.linspace(0.0, 1.0, 11), manifold=SimpleNamespace(X=torch.zeros(100, 3)))
HEAD, ROW = "t,particle,x,deviation", "0.1,5,0.5,1e-3"
CSV = f"{HEAD}\n{ROW}\n"
COLUMNS = {"t": [0.1, 0.2], "particle": [5, 6], "x": [0.5, 0.4], "deviation": [1e-3, 1e-3]}


def refused(path, *words):
    """A file is refused in one line with these words."""
    with pytest.raises(NSFError) as told:
        Observations.read(path, MODEL)
    text = str(told.value)
    assert "\n" not in text
    for word in (path.name, *words):
        assert word in text
    return text


def hdf5(path, **changes):
    with h5py.File(path, "w") as file:
        for name, values in (COLUMNS | changes).items():
            if values is not None:
                file[name] = np.array(values)
    return path


# -- text -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (f"{HEAD}\n{ROW},7\n", ("4 fields", "line 2", "saw 5")),
        (f"{HEAD}\n0.1,5\n", ("row 1", "observes nothing")),
        (f"{HEAD},x\n{ROW},0.7\n", ("the column x twice",)),
        (f"{HEAD},quantity,value\n{ROW},height,0.2\n", ("row 1", "height", "particle", "own row")),
        (f"{HEAD},value\n{ROW},0.2\n", ("row 1", "value=0.2", "quantity")),
        (f"{HEAD},X,Y,Z\n{ROW},0,0,0\n", ("row 1", "particle", "X, Y, Z")),
        (f"{HEAD},X\n{ROW},0\n", ("row 1", "X")),
        (f"{HEAD}\n0.1,5,,1e-3\n", ("row 1", "observes nothing")),
        (f"{HEAD}\n0.1,5,0.5+2j,1e-3\n", ("row 1", "x=0.5+2j")),
        (f"{HEAD}\n0.1,5,1_0,1e-3\n", ("row 1", "x=1_0")),
        (CSV.replace(",", ";"), ("separate columns by commas",)),
        (f'{HEAD}\n0.1,5,"0.5,1e-3\n', ("no CSV file",)),
        ("", ("no rows",)),
        (f"{HEAD}\n", ("no rows",)),
    ],
)
def test_what_would_be_lost_is_refused(tmp_path, text, words):
    path = tmp_path / "seen.csv"
    path.write_text(text)
    refused(path, *words)


def test_text_that_other_programs_write(tmp_path):
    path = tmp_path / "seen.csv"
    path.write_bytes(b"\xef\xbb\xbf" + CSV.replace(",", ", ").replace("\n", "\r\n").encode() + b"\r\n")
    seen = Observations.read(path, MODEL)
    np.testing.assert_allclose(seen.values, [0.5])
    path.write_text("t,quantity,value,deviation\n,height,0.2,1e-3\nNaN,run_out,0.1,1e-3\n")
    assert Observations.read(path, MODEL).t.tolist() == [1.0, 1.0]


def test_text_is_utf_8(tmp_path):
    path = tmp_path / "seen.csv"
    path.write_bytes(CSV.replace("t,", "t\xe9,").encode("latin-1"))
    refused(path, "UTF-8")
    path.write_text(CSV, encoding="utf-16")
    refused(path, "UTF-8")


@pytest.fixture
def short(monkeypatch):
    """Files may have a thousandth of the rows, and a hundredth of the bytes."""
    monkeypatch.setattr(columns, "_MOST_ROWS", columns._MOST_ROWS // 1000)
    monkeypatch.setattr(columns, "_MOST_BYTES", columns._MOST_BYTES // 100)


def test_rows_beyond_the_most(tmp_path, short):
    path = tmp_path / "seen.csv"
    path.write_text(f"{HEAD}\n" + f"{ROW}\n" * 1001)
    refused(path, "1,000 rows")


# -- compression ----------------------------------------------------------------------------------------


def test_a_compressed_file(tmp_path):
    path = tmp_path / "seen.csv.gz"
    path.write_bytes(gzip.compress(CSV.encode()))
    assert Observations.read(path, MODEL).what == ("x",)


@pytest.mark.parametrize("line", [b"\n", b" " * 4000 + b"\n", f"{ROW}\n".encode(), b" "])
def test_a_bomb(tmp_path, line, short):
    # 6 MB of such lines took 13 GB.
    whole = io.BytesIO()
    with gzip.GzipFile(fileobj=whole, mode="wb", compresslevel=1) as packed:
        packed.write(f"{HEAD}\n".encode())
        block = line * (2**20 // len(line))
        for _ in range(3):
            packed.write(block)
    path = tmp_path / "seen.csv.gz"
    path.write_bytes(whole.getvalue())
    refused(path)


@pytest.mark.parametrize("pack", [bz2.compress, lambda data: zipped(data), gzip.compress])
def test_packed_text_is_refused_but_for_gzip(tmp_path, pack):
    path = tmp_path / "seen.csv"
    path.write_bytes(pack(CSV.encode()))
    refused(path, "no UTF-8 text", "csv.gz")


def zipped(data):
    held = io.BytesIO()
    with zipfile.ZipFile(held, "w") as archive:
        archive.writestr("seen.csv", data)
    return held.getvalue()


def test_an_hdf5_file_is_named_so(tmp_path):
    refused(hdf5(tmp_path / "seen.h5").rename(tmp_path / "seen.csv"), "HDF5", "h5")


def test_a_broken_archive(tmp_path):
    path, whole = tmp_path / "seen.csv.gz", gzip.compress((CSV + f"{ROW}\n" * 200).encode())
    for data in (whole[:20], whole[:-4], b"", CSV.encode(), whole[:-6] + b"\0" + whole[-5:], whole + b"more"):
        path.write_bytes(data)
        refused(path)


# -- HDF5 -----------------------------------------------------------------------------------------------


def test_numbers_and_text_of_any_width(tmp_path):
    named = np.array([b"height", b"run_out"])
    blank = dict.fromkeys(("particle", "x"), None)
    for quantity in (named, named.astype(object)):
        path = hdf5(tmp_path / "seen.h5", **blank, value=np.float32([0.1, 0.2]), quantity=quantity, t=[0, 1])
        assert Observations.read(path, MODEL).what == ("height", "run_out")
    path = hdf5(tmp_path / "seen.h5", t=np.array([0.1, 0.2], ">f4"))
    np.testing.assert_allclose(Observations.read(path, MODEL).t, [0.1, 0.2], atol=1e-7)


def test_columns_that_lie_elsewhere(tmp_path):
    other = hdf5(tmp_path / "other.h5")
    path = tmp_path / "seen.h5"

    def link(put):
        hdf5(path, x=None)
        with h5py.File(path, "a") as file:
            put(file)
        return path

    raw = tmp_path / "raw"
    raw.write_bytes(np.array([0.5, 0.4]).tobytes())
    layout = h5py.VirtualLayout((2,), "f8")
    layout[:] = h5py.VirtualSource(str(other), "x", (2,))
    for put in (
        lambda file: file.__setitem__("x", h5py.ExternalLink(str(other), "x")),
        lambda file: file.__setitem__("x", h5py.SoftLink("/t")),
        lambda file: file.__setitem__("x", h5py.SoftLink("/x")),
        lambda file: file.create_dataset("x", (2,), "f8", external=[(str(raw), 0, 16)]),
        lambda file: file.create_virtual_dataset("x", layout),
        lambda file: file.__setitem__("x", file["/"]),
        lambda file: file.create_group("x"),
    ):
        refused(link(put), "x")


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"x": np.array([0.5 + 2j, 0.4])}, ("x", "complex", "numbers")),
        ({"x": np.array([[0.5], [0.4]])}, ("x", "[2, 1]")),
        ({"x": np.float64(0.5)}, ("x",)),
        ({"x": np.array([0.5])}, ("x", "[1]", "[2]")),
        ({"x": np.array([True, False])}, ("x", "numbers")),
        ({"x": np.array([b"left", b"right"])}, ("x", "numbers")),
        ({"quantity": np.array([1.0, 2.0])}, ("quantity", "text")),
        ({"quantity": np.array([b"h" * 80] * 2, object)}, ("quantity", "80 bytes")),
        ({"quantity": np.array([b"\xff", b""], "S6")}, ("utf-8",)),
        ({"deep": np.array([1.0, 1.0])}, ("the column 'deep'", "leave it out")),
        ({name: np.zeros(1001) for name in COLUMNS}, ("1,000 rows",)),
    ],
)
def test_columns_of_another_kind(tmp_path, changes, words, short):
    refused(hdf5(tmp_path / "seen.h5", **changes), *words)


def test_packed_columns(tmp_path):
    path = hdf5(tmp_path / "seen.h5", x=None)
    with h5py.File(path, "a") as file:
        file.create_dataset("x", data=np.zeros(2), compression="gzip")
    refused(path, "x", "gzip")


def test_flipped_bits_end_in_a_line_or_in_numbers(tmp_path):
    path = tmp_path / "seen.h5"
    whole = bytearray(hdf5(path, quantity=np.array(["", ""], object)).read_bytes())
    for at in range(0, len(whole), 37):
        damaged = bytearray(whole)
        damaged[at] ^= 1 << at % 8
        path.write_bytes(damaged)
        with suppress(NSFError):
            Observations.read(path, MODEL)
    path.write_bytes(whole[: len(whole) // 2])
    refused(path)


def test_a_damaged_heap_of_texts_ends(tmp_path):
    """HDF5 itself walks an object of no size for ever."""
    names = np.array(["height", "run_out"], object)
    path = hdf5(tmp_path / "seen.h5", particle=None, x=None, value=np.array([0.1, 0.2]), quantity=names)
    assert Observations.read(path, MODEL).what == ("height", "run_out")
    whole = bytearray(path.read_bytes())
    heap = whole.index(b"GCOL")
    for at in (8, 24, 16):  # sizes of the heap and of its first object, and the index of that
        damaged = bytearray(whole)
        damaged[heap + at : heap + at + 8] = bytes(8)
        path.write_bytes(damaged)
        refused(path, "write it again")


def test_places_without_a_file(tmp_path):
    refused(tmp_path, "no file")
    (tmp_path / "loop.csv").symlink_to(tmp_path / "loop.csv")
    refused(tmp_path / "loop.csv", "no file")
