"""Archives that would run code, or take a thousand times their size in memory, are refused unread."""

import io
import pickle
import tracemalloc
import zipfile
from collections import OrderedDict

import numpy as np
import pytest
import torch

from nsf.data import archives
from nsf.errors import MissingRunError, SchemaError


class Calls:
    """Pickles as a call."""

    def __init__(self, function, *arguments):
        self.call = function, arguments

    def __reduce__(self):
        return self.call


def repacked(path, compression=zipfile.ZIP_STORED, **members):
    """Write an archive again, with other members beside or in place of its own."""
    with zipfile.ZipFile(path) as archive:
        own = {name: archive.read(name) for name in archive.namelist()}
        top = next(iter(own)).split("/")[0]
    with zipfile.ZipFile(path, "w", compression) as archive:
        for name, data in (own | {f"{top}/{name}": data for name, data in members.items()}).items():
            archive.writestr(name, data)


def opened(path, read):
    tracemalloc.start()
    try:
        with pytest.raises(SchemaError) as refusal:
            read(path, "checkpoint", "train")
        assert tracemalloc.get_traced_memory()[1] < 2**24
    finally:
        tracemalloc.stop()
    return str(refusal.value)


def test_plain_data_come_back(tmp_path):
    content = {"a": [torch.arange(3), 1.5, None], "b": OrderedDict(c=torch.nn.Parameter(torch.ones(2)))}
    archives.keep(tmp_path / "kept.pt", content)
    found = archives.kept(tmp_path / "kept.pt", pytest.fail)
    assert torch.equal(found["a"][0], content["a"][0])
    assert torch.equal(found["b"]["c"], content["b"]["c"])
    assert archives.kept(tmp_path / "none.pt", pytest.fail) is None


def test_tensors_that_inflate_are_refused(tmp_path):
    path = tmp_path / "bomb.pt"
    torch.save({"state": torch.zeros(2**26, dtype=torch.uint8)}, path)
    repacked(path, zipfile.ZIP_DEFLATED)
    assert path.stat().st_size < 2**18
    assert "compressed" in opened(path, archives.tensors)


def test_a_pickle_that_claims_memory_or_runs_code_is_refused(tmp_path):
    path = tmp_path / "calls.pt"
    for call in (Calls(bytearray, 2**33), Calls(print, "x")):
        torch.save({"a": torch.zeros(2)}, path)
        repacked(path, **{"data.pkl": pickle.dumps(call, 2)})
        assert "calls" in opened(path, archives.tensors)


def test_a_tensor_that_is_larger_than_its_file_is_refused(tmp_path):
    torch.save(torch.zeros(1).expand(2**40), tmp_path / "wide.pt")
    assert "larger than the file" in opened(tmp_path / "wide.pt", archives.tensors)


@pytest.mark.parametrize("data", [b"", b"PK\5\6" + bytes(18), pickle.dumps(1)])
def test_other_files_are_refused(tmp_path, data):
    path = tmp_path / "other"
    path.write_bytes(data)
    opened(path, archives.tensors)
    if not data.startswith(b"PK"):
        opened(path, archives.arrays)
    with pytest.raises(MissingRunError, match="nsf train"):
        archives.arrays(tmp_path / "none", "checkpoint", "train")


def npz(path, **members):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in members.items():
            archive.writestr(f"{name}.npy", data)


def npy(values, shape=None):
    stream = io.BytesIO()
    header = {"descr": values.dtype.str, "fortran_order": False, "shape": shape or values.shape}
    np.lib.format.write_array_header_1_0(stream, header)
    return stream.getvalue() + values.tobytes()


def test_arrays_come_back(tmp_path):
    values = {"x": np.arange(6.0).reshape(2, 3), "case": np.array(["a=1", "b"]), "t": np.float32(3)}
    np.savez_compressed(tmp_path / "a.npz", **values)
    found = archives.arrays(tmp_path / "a.npz", "frames", "evaluate")
    assert found.keys() == values.keys()
    assert all(np.array_equal(found[name], values[name]) for name in values)


def test_arrays_that_inflate_or_claim_more_than_they_have_are_refused(tmp_path):
    path, ones = tmp_path / "bomb.npz", np.zeros(3)
    npz(path, x=npy(np.zeros(2**24)))
    assert path.stat().st_size < 2**18
    with pytest.raises(SchemaError, match="takes more than"):
        archives.arrays(path, "frames", "evaluate")
    for data in (npy(ones, (2**40,)), npy(ones, (-1, -3)), npy(np.array([None])), b"\x93NUMPY\1\0"):
        npz(path, x=data)
        with pytest.raises(SchemaError, match="truncated or no frames"):
            archives.arrays(path, "frames", "evaluate")
