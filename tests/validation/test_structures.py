"""Structures with a closed form: a vibrating bar, a block on an incline (physics.md, section 3)."""

import math

import numpy as np
import pytest

from nsf.mpm import DomainWalls, HalfSpace, Transfer
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


THETA, PHI, G, T = math.radians(24.0), math.radians(15.0), 10.0, 0.3


@pytest.fixture
def slide(lattice, solver_of):
    """(frame, φ) → displacement [m] along and normal to the incline of a block after T, domain 1 m.

    A stiff block, so that the start (a shear wave crossing it before all of it slides) takes little time.
    """

    def run(frame, phi):
        floor = np.array([0.25, 0.375, 0.5])
        local = lattice([0.0] * 3, [0.25, 0.25, 0.125], 1.0 / 32.0)
        if frame == "tilted gravity":
            along, normal = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0])
            gravity = G * (math.sin(THETA) * along - math.cos(THETA) * normal)
        else:
            along, normal = (
                np.array([math.cos(THETA), 0.0, -math.sin(THETA)]),
                np.array([math.sin(THETA), 0.0, math.cos(THETA)]),
            )
            gravity = np.array([0.0, 0.0, -G])
        # A hair above the nodes, so that those on the plane belong to the incline.
        X = floor + local @ np.stack([along, [0.0, 1.0, 0.0], normal]) + 1e-9 * normal
        incline = HalfSpace(floor + 1e-9 * normal, normal, "separate", math.tan(phi))
        material = FixedCorotated(3e4, 0.3)
        solver = solver_of(
            X,
            1.0 / 32.0,
            1.0 / 16.0,
            T / 2400,
            material=material,
            gravity=gravity,
            colliders=[incline],
            walls=DomainWalls(),
        )
        solver.step(2400)
        moved = (solver.state.x.numpy() - X).mean(0)
        return moved @ along, moved @ normal

    return run


def test_block_slides_down_an_incline(slide):
    """½ g t² (sin θ − tan φ cos θ) at θ 24°, φ 15°, within 1e-3 of the domain."""
    along, normal = slide("tilted plane", PHI)
    expected = 0.5 * G * T**2 * (math.sin(THETA) - math.tan(PHI) * math.cos(THETA))
    assert expected == pytest.approx(0.0728788, abs=1e-6)
    assert along == pytest.approx(expected, abs=1e-3)
    assert abs(normal) < 1e-3


def test_block_rests_where_friction_exceeds_the_slope(slide):
    along, _ = slide("tilted gravity", math.radians(30.0))
    assert abs(along) < 1e-3
