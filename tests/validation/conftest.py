"""What the validation tests of the material point method share."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
import warp as wp

from nsf.mpm import DomainWalls, FullOrderMPM, GridGeometry, ParticleConstants, precision_of
from nsf.mpm.materials import FixedCorotated, make_elastic_stress, make_stress_update

#: Single-point tolerance, relative (physics.md, section 3).
TOLERANCE = {"fp64": 1e-10, "fp32": 1e-5}


@pytest.fixture(params=["fp64", "fp32"])
def precision(request):
    return request.param


@pytest.fixture
def tolerance(precision):
    return TOLERANCE[precision]


@pytest.fixture
def rng():
    return np.random.default_rng(20230)


@pytest.fixture(scope="session")
def elastic_tau():
    """(material, F [n, 3, 3], precision) → Kirchhoff stress [n, 3, 3] of the elastic law, no flow so far."""

    def evaluate(material, F, precision="fp64"):
        types = precision_of(precision)
        F = np.asarray(F, float).reshape(-1, 3, 3)
        moduli = [
            wp.full(len(F), types.real(m), dtype=types.real, device="cpu")
            for m in (material.mu, material.lam)
        ]
        tau = wp.zeros(len(F), dtype=types.mat33, device="cpu")
        kernel = make_elastic_stress(material.functions(types), types, material.history_size)
        vecH = wp.types.vector(length=material.history_size, dtype=types.real)
        history = wp.array(material.initial_history(len(F)), dtype=vecH, device="cpu")
        inputs = [wp.array(F, dtype=types.mat33, device="cpu"), history, *moduli, tau]
        wp.launch(kernel, dim=len(F), inputs=inputs, device="cpu")
        return tau.numpy().astype(float)

    return evaluate


@pytest.fixture(scope="session")
def invariants():
    """tau [..., 3, 3] → trace and norm of the deviator."""

    def split(tau):
        trace = np.trace(tau, axis1=-2, axis2=-1)
        return trace, np.linalg.norm(tau - trace[..., None, None] / 3.0 * np.eye(3), axis=(-2, -1))

    return split


@dataclass
class Points:
    """Material points side by side: (increment [n, 3, 3], dt) → a step; then F_e, history, tau hold it."""

    F_e: np.ndarray
    history: np.ndarray
    tau: np.ndarray
    step: Callable


@pytest.fixture(scope="session")
def material_points():
    """(material, n, precision) → n points at rest that the law's own kernel steps."""

    def build(material, n, precision="fp64"):
        types = precision_of(precision)
        update = make_stress_update(material.functions(types), types, material.history_size)
        vecH = wp.types.vector(length=material.history_size, dtype=types.real)
        moduli = [
            wp.full(n, types.real(m), dtype=types.real, device="cpu") for m in (material.mu, material.lam)
        ]

        def step(increment, dt=1.0):
            F_e = wp.array(points.F_e, dtype=types.mat33, device="cpu")
            history = wp.array(points.history, dtype=vecH, device="cpu")
            tau = wp.zeros(n, dtype=types.mat33, device="cpu")
            increment = wp.array(np.broadcast_to(increment, (n, 3, 3)), dtype=types.mat33, device="cpu")
            inputs = [increment, *moduli, material.params(types), types.real(dt), F_e, history, tau]
            wp.launch(update, dim=n, inputs=inputs, device="cpu")
            points.F_e, points.history, points.tau = (a.numpy().astype(float) for a in (F_e, history, tau))
            return points

        points = Points(np.tile(np.eye(3), (n, 1, 1)), material.initial_history(n), np.zeros((n, 3, 3)), step)
        return points

    return build


@pytest.fixture(scope="session")
def lattice():
    """(lower [3], upper [3], spacing) → points at the centres of cubes of edge `spacing` [m]."""

    def points(lower, upper, spacing):
        axes = [
            lo + spacing * (np.arange(round((hi - lo) / spacing)) + 0.5)
            for lo, hi in zip(lower, upper, strict=True)
        ]
        return np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)

    return points


@pytest.fixture(scope="session")
def solver_of():
    """(X, spacing, dx, dt, size, ...) → a CPU solver of equal particles of volume spacing³."""

    def build(
        X, spacing, dx, dt, size=(1.0, 1.0, 1.0), density=1.0, material=FixedCorotated(10.0, 0.3), **options
    ):
        P = len(X)
        volume0 = np.full(P, spacing**3)
        constants = ParticleConstants(
            X, density * volume0, volume0, np.full(P, material.mu), np.full(P, material.lam)
        )
        options.setdefault("walls", DomainWalls("separate", 1))
        return FullOrderMPM(
            constants, material, GridGeometry.of_domain(size, dx), dt, device="cpu", **options
        )

    return build


@pytest.fixture(scope="session")
def rotation():
    """(generator, n) → n random proper rotations [n, 3, 3]."""

    def draw(rng, n):
        Q = np.linalg.qr(rng.normal(size=(n, 3, 3)))[0]
        return Q * np.linalg.det(Q)[:, None, None]

    return draw


@pytest.fixture
def deformations(rng):
    """[200, 3, 3] F ≈ I + 0.3 N; near-singular and inverted draws are passed over."""
    F = np.eye(3) + 0.3 * rng.normal(size=(400, 3, 3))
    F = F[np.linalg.det(F) > 0.2]
    assert len(F) >= 200
    return F[:200]
