"""x̂ of seven tiny scenes by every model, and full-order positions: arithmetic alone, in double precision."""

import pytest
from chains import close, latents, read
from configurations import PAPER


@pytest.mark.parametrize("scene", PAPER)
def test_steps_are_the_same(chains, scene):
    close(latents(chains, scene), read("latents")[scene], 1e-12, scene)
