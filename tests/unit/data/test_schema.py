"""Names on disk."""

import hashlib
import struct
import subprocess
import sys

import numpy as np
import pytest

from nsf.data import TAU_MATRIX, TAU_ORDER, hash_of_positions
from nsf.data.schema import COMPONENTS, UNITS, packed
from nsf.errors import ShapeError


def test_tau_is_its_upper_triangle_by_rows():
    matrix = np.array([[[1.0, 2, 3], [2, 4, 5], [3, 5, 6]]])
    assert TAU_ORDER == ("xx", "xy", "xz", "yy", "yz", "zz")
    assert packed("tau", matrix).tolist() == [[1, 2, 3, 4, 5, 6]]
    assert np.array_equal(packed("tau", matrix)[..., TAU_MATRIX], matrix)
    torch = pytest.importorskip("torch")
    assert torch.equal(torch.from_numpy(packed("tau", matrix))[..., TAU_MATRIX], torch.from_numpy(matrix))


def test_affine_matrices_lie_by_rows():
    C = np.arange(18.0).reshape(2, 3, 3)
    assert np.array_equal(packed("C", C), C.reshape(2, 9))
    assert packed("x", np.zeros((3, 3))).shape == (3, 3)


def test_the_hash_is_over_little_endian_float64():
    X = [[0.0, 1.0, 2.0], [0.5, 0.25, -3.0]]
    expected = hashlib.sha256(struct.pack("<6d", *X[0], *X[1])).hexdigest()
    assert hash_of_positions(X) == expected
    assert hash_of_positions(np.asfortranarray(np.array(X, dtype=">f8"))) == expected
    assert hash_of_positions(np.array(X)[::-1]) != expected


@pytest.mark.parametrize("X", [np.zeros(3), np.zeros((4, 2)), np.full((2, 3), np.nan)])
def test_the_hash_refuses_what_is_no_positions(X):
    with pytest.raises(ShapeError, match=r"\[P,3\]"):
        hash_of_positions(X)


def test_every_field_has_a_unit():
    assert COMPONENTS.keys() <= UNITS.keys()


def test_writing_needs_no_torch():
    code = (
        "import sys; from nsf.data import TrajectoryWriter, Trajectory, Split\n"
        "assert not {'torch', 'pytorch_lightning', 'warp'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
