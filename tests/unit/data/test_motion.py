"""What is said of a body to which next to nothing happens, or that ends flat."""

import numpy as np
import pytest

from nsf.data.motion import FLAT, RIGID, STILL, motion_warnings

X = np.random.default_rng(0).random((200, 3))
TURN = np.array([[0.8, -0.6, 0.0], [0.6, 0.8, 0.0], [0.0, 0.0, 1.0]])


@pytest.mark.parametrize(
    ("x", "lines"),
    [
        (X + 1e-4, [STILL]),
        (X @ TURN + [0.0, 0.0, -2.0], [RIGID]),
        (X * [1.0, 1.0, 0.05], [FLAT]),
        (X * [1.0, 1.0, 0.5], []),
    ],
)
def test_a_body_to_which_nothing_happens_is_warned_of(x, lines):
    assert motion_warnings(X, x, dx=0.1) == lines
