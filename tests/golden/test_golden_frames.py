"""Positions that an export decodes, at particles and at points between them."""

import pytest
from chains import close, frames, read


@pytest.mark.parametrize(("name", "points"), [("particles", None), ("between", 300)])
def test_positions_are_the_same(chains, name, points):
    close(frames(chains, points), read("frames")[name], 1e-12, name)
