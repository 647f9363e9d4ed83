"""Structures with a closed form: a vibrating bar (physics.md, section 3)."""

import math

import numpy as np
import pytest

from nsf.mpm import HalfSpace, Transfer
from nsf.mpm.materials import FixedCorotated, Hencky

FAR = 1e3
# Slides along every plane normal to y and z, through the whole domain: motion along x only.
ALONG_X = [
    HalfSpace((0.0, FAR, 0.0), (0.0, 1.0, 0.0), "slip"),
    HalfSpace((0.0, 0.0, FAR), (0.0, 0.0, 1.0), "slip"),
]


@pytest.mark.parametrize("shape", ["quadratic", "cubic"])
@pytest.mark.parametrize("law", [FixedCorotated, Hencky])
def test_vibrating_bar(law, shape, solver_of):
    """ω₁ = (π/2L)√(E/ρ) = 0.628319 within 1 %: E 100, ρ 1, L 25, ν 0, v = 0.1 cos ω₁t sin(πx/2L).

    One row of particles, held at x = 0 and kept on its axis. The first layer of cells holds the
    end less stiffly than a clamp, so the error is of first order in Δx: −0.6 % here, −0.3 % at half of it.
    """
    L, omega, dx, end = 25.0, 0.628319, 0.5, 5.0
    x = 0.25 * (np.arange(100) + 0.5)
    X = np.stack([end + x, np.full(100, 3.0), np.full(100, 3.0)], -1)
    mode = np.sin(math.pi * x / (2.0 * L))
    v = np.zeros_like(X)
    v[:, 0] = 0.1 * mode
    clamp = HalfSpace((end + 1e-6, 0.0, 0.0), (1.0, 0.0, 0.0), "sticky")
    solver = solver_of(
        X,
        0.25,
        dx,
        0.02,
        (36.0, 6.0, 6.0),
        1.0,
        law(100.0, 0.0),
        colliders=[clamp, *ALONG_X],
        transfer=Transfer(shape=shape),
        v=v,
    )
    amplitude = []
    for _ in range(1300):  # 2.6 periods
        solver.step()
        amplitude.append(mode @ solver.state.v.numpy()[:, 0])
    amplitude, t = np.array(amplitude), 0.02 * np.arange(1, 1301)
    k = np.nonzero(amplitude[:-1] * amplitude[1:] < 0)[0]
    assert len(k) == 5
    zeros = t[k] - amplitude[k] * 0.02 / (amplitude[k + 1] - amplitude[k])
    observed = math.pi * (len(k) - 1) / (zeros[-1] - zeros[0])
    assert observed == pytest.approx(omega, rel=0.01)
