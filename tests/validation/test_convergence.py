"""Order of convergence on the generalised vortex (physics.md, section 3; Kamojjala et al. 2015, section 5.3).

The ring 0.75 < R < 1.25 turns by α(R, t) = g(t) h(R) about its axis, h = (1 − 16(R − 1)²)² and
g = A (1 − cos πt)/2: isochoric plane strain that leaves both rims undeformed and free of traction.
"""

import math

import numpy as np
import pytest

from nsf.mpm import HalfSpace, Transfer
from nsf.mpm.materials import Hencky

MATERIAL, RHO, A, T = Hencky(1000.0, 0.3), 1000.0, 0.1, 1.0
CENTRE = 1.5


def profile(R):
    """h, h', h'' of R; zero off the ring."""
    s = R - 1.0
    k = 1.0 - 16.0 * s * s
    on = np.abs(s) < 0.25
    return on * k * k, on * -64.0 * s * k, on * (2048.0 * s * s - 64.0 * k)


def swing(t):
    """g, g', g'' of t."""
    w = math.pi
    return 0.5 * A * (1.0 - math.cos(w * t)), 0.5 * A * w * math.sin(w * t), 0.5 * A * w * w * math.cos(w * t)


def turned(x, angle):
    c, s = np.cos(angle), np.sin(angle)
    return np.stack([c * x[:, 0] - s * x[:, 1], s * x[:, 0] + c * x[:, 1]], -1)


def body_force(x, t):
    """b = a − (div τ)/ρ [m/s²] at points x [n, 2] from the axis.

    With shear γ = R g h' the Hencky stress (J = 1, so Cauchy too) is τ_rθ = s(γ) = 4μ̂ asinh(γ/2)/√(4 + γ²),
    τ_θθ = −τ_rr = γ s/2; its divergence is −(γ s)'/2 − γ s/r along r and s' + 2 s/r along θ.
    """
    r = np.linalg.norm(x, axis=1)
    h, dh, ddh = profile(r)
    g, dg, ddg = swing(t)
    gamma, dgamma = g * r * dh, g * (dh + r * ddh)
    root = np.sqrt(4.0 + gamma * gamma)
    s = 4.0 * MATERIAL.mu * np.arcsinh(0.5 * gamma) / root
    ds = 4.0 * MATERIAL.mu * (1.0 / root**2 - gamma * np.arcsinh(0.5 * gamma) / root**3) * dgamma
    radial = -r * (dg * h) ** 2 + (0.5 * (dgamma * s + gamma * ds) + gamma * s / r) / RHO
    around = r * ddg * h - (ds + 2.0 * s / r) / RHO
    outward = x / r[:, None]
    return radial[:, None] * outward + around[:, None] * turned(outward, np.full(len(x), math.pi / 2.0))


def motion(X, t):
    """φ(X, t) of points X [n, 2] from the axis."""
    return turned(X, swing(t)[0] * profile(np.linalg.norm(X, axis=1))[0])


def first_piola(X, t, elastic_tau, h=1e-3):
    """P [n, 2, 2] from F, a difference of order 4 of the motion."""
    F = np.tile(np.eye(3), (len(X), 1, 1))
    for j in range(2):
        e = h * np.eye(2)[j]
        near, far = (motion(X + k * e, t) - motion(X - k * e, t) for k in (1, 2))
        F[:, :2, j] = (8.0 * near - far) / (12.0 * h)
    return (elastic_tau(MATERIAL, F) @ np.linalg.inv(F).transpose(0, 2, 1))[:, :2, :2]


def test_body_force_balances_the_motion(rng, elastic_tau):
    """ρ₀ (a − b) = Div P against differences of motion and stress, independent of the algebra above."""
    R, angle, t, h = rng.uniform(0.78, 1.22, 40), rng.uniform(0.0, 2.0 * math.pi, 40), 0.6, 1e-3
    X = R[:, None] * np.stack([np.cos(angle), np.sin(angle)], -1)
    divergence = np.zeros_like(X)
    for j in range(2):
        e = h * np.eye(2)[j]
        near, far = (
            first_piola(X + k * e, t, elastic_tau) - first_piola(X - k * e, t, elastic_tau) for k in (1, 2)
        )
        divergence += (8.0 * near - far)[:, :, j] / (12.0 * h)
    x = {k: motion(X, t + k * h) for k in (-2, -1, 0, 1, 2)}
    acceleration = (16.0 * (x[1] + x[-1]) - x[2] - x[-2] - 30.0 * x[0]) / (12.0 * h * h)
    np.testing.assert_allclose(body_force(x[0], t), acceleration - divergence / RHO, rtol=0, atol=1e-4)


@pytest.fixture
def vortex_error(solver_of):
    """(cells per unit length, transfer) → RMS error of the position at T over the RMS displacement."""

    def run(cells, transfer):
        dx, spacing = 1.0 / cells, 0.5 / cells
        axis = spacing * (np.arange(6 * cells) + 0.5) - CENTRE
        X = np.stack(np.meshgrid(axis, axis, indexing="ij"), -1).reshape(-1, 2)
        X = X[np.abs(np.linalg.norm(X, axis=1) - 1.0) < 0.25]
        steps = math.ceil(T / (0.4 * dx / math.sqrt((MATERIAL.lam + 2.0 * MATERIAL.mu) / RHO)))
        dt = T / steps
        v = np.zeros((len(X), 3))
        # Velocities lie half a step behind positions, so that the stepping is of second order.
        v[:, :2] = (motion(X, 0.0) - motion(X, -dt)) / dt
        plane = HalfSpace((0.0, 0.0, 1e3), (0.0, 0.0, 1.0), "slip")  # no motion along z anywhere
        X3 = np.concatenate([X + CENTRE, np.full((len(X), 1), 6.0 * dx)], 1)
        solver = solver_of(
            X3,
            spacing,
            dx,
            dt,
            (3.0, 3.0, 12.0 * dx),
            RHO,
            MATERIAL,
            colliders=[plane],
            transfer=transfer,
            v=v,
        )
        for k in range(steps):
            now = solver.state.v.numpy()
            now[:, :2] += dt * body_force(solver.state.x.numpy()[:, :2] - CENTRE, k * dt)
            solver.state.v.assign(now)
            solver.step()
        expected = motion(X, T)
        error = solver.state.x.numpy()[:, :2] - CENTRE - expected
        return np.linalg.norm(error) / np.linalg.norm(expected - X)

    return run


@pytest.mark.parametrize("shape", ["quadratic", pytest.param("cubic", marks=pytest.mark.slow)])
def test_order_of_convergence(shape, vortex_error):
    """At least 1.5 with Δt ∝ Δx and 4 particles a cell, before the plateau (from 1/64 on)."""
    cells = np.array([8, 16, 32])
    errors = np.array([vortex_error(n, Transfer("apic", shape)) for n in cells])
    order = -np.polyfit(np.log(cells), np.log(errors), 1)[0]
    assert order >= 1.5
    assert errors[-1] < 0.02
