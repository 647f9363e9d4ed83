"""Vectors from a yaml, from Python and from NumPy."""

import numpy as np
import pytest

from nsf.errors import ConfigError
from nsf.vectors import direction, rotation, vector


@pytest.mark.parametrize("kind", [list, tuple, np.array, lambda v: np.array(v, np.float32)])
def test_whatever_holds_three_numbers_is_a_vector(kind):
    assert vector("point", kind([1, 2, 3])) == (1.0, 2.0, 3.0)


@pytest.mark.parametrize("values", [[1.0, 2.0], [1.0, 2.0, True], [1.0, 2.0, np.nan], 3.0])
def test_what_does_not_is_refused(values):
    with pytest.raises(ConfigError, match=r"point=.* m must be 3 finite numbers"):
        vector("point", values, "m")


def test_a_direction_has_length_one():
    assert np.linalg.norm(direction("normal", np.array([0, 3, 4]))) == pytest.approx(1.0)
    with pytest.raises(ConfigError, match=r"normal=.* has no direction"):
        direction("normal", [0, 0, 0])


def test_a_rotation_turns_right_handed():
    R = rotation(np.array([0.0, 0.0, 1.0]), 90.0)
    assert np.allclose(R @ [1.0, 0.0, 0.0], [0.0, 1.0, 0.0])
    assert np.allclose(R @ R.T, np.eye(3))
