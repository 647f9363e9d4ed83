"""Herschel-Bulkley: steady shear, relaxation, the return (physics.md, section 3)."""

import math

import numpy as np
import pytest

from nsf.mpm.materials import HerschelBulkley, drive

E, NU = 1e6, 0.3
MU, KAPPA = 1e6 / 2.6, 1e6 / 1.2
SIGMA_Y, ETA, DT = 4e5, 50.0, 1e-4


def radius(sigma_Y):
    return math.sqrt(2.0 / 3.0) * sigma_Y


def trial_stress(F):
    """Pressure part [n], deviator s [n, 3, 3] and ‖s‖ [n] of the elastic law, by NumPy."""
    J = np.linalg.det(F)
    b = J[:, None, None] ** (-2.0 / 3.0) * F @ F.transpose(0, 2, 1)
    s = MU * (b - np.trace(b, axis1=1, axis2=2)[:, None, None] / 3.0 * np.eye(3))
    return 0.5 * KAPPA * (J**2 - 1.0), s, np.linalg.norm(s, axis=(1, 2))


def returned_size(size, sigma_Y, eta, dt):
    """‖s‖ after the return: the root of η (s_trial − s) = 2μ̂Δt (s − √(2/3) σ_Y), if that is below s_trial."""
    root = (eta * size + 2.0 * MU * dt * radius(sigma_Y)) / (eta + 2.0 * MU * dt)
    return np.where(size > radius(sigma_Y), root, size)


def energy(F):
    J = np.linalg.det(F)
    trace = J ** (-2.0 / 3.0) * (F**2).sum((-2, -1))
    return 0.5 * KAPPA * (0.5 * (J**2 - 1.0) - np.log(J)) + 0.5 * MU * (trace - 3.0)


def rotation_of(F):
    U, _, Vt = np.linalg.svd(F)
    return U @ Vt


@pytest.mark.parametrize("path", ["simple shear", "pure shear"])
@pytest.mark.parametrize("dt", [1e-6, 1e-5, 1e-4, 1e-3])
def test_steady_shear(path, dt, invariants):
    """‖s‖ = √(2/3) σ_Y + η γ̇/√2 for Δt from far below to far above the relaxation time η/(2μ̂) = 65 µs."""
    sigma_Y, eta, rate = 100.0, 50.0, 2.0
    expected = radius(sigma_Y) + eta * rate / math.sqrt(2.0)
    assert expected == pytest.approx(152.360336, abs=5e-7)
    steps = max(20, round(3e-3 / dt))
    gamma = rate * dt * np.arange(1, steps + 1)
    F = np.tile(np.eye(3), (steps, 1, 1))
    if path == "simple shear":
        F[:, 0, 1] = gamma
    else:
        F[:, 0, 0], F[:, 1, 1] = np.exp(0.5 * gamma), np.exp(-0.5 * gamma)
    tau = drive(HerschelBulkley(E, NU, sigma_Y, eta), F, dt)[-1]
    assert invariants(tau)[1] == pytest.approx(expected, rel=1e-6)
    if path == "simple shear":
        assert tau[0, 1] == pytest.approx(expected / math.sqrt(2.0), rel=1e-5)


def test_power_of_steady_shear_is_dissipated(material_points):
    """Energy lost in a return: that of the flow γ̇Δt/√2, at the mean of ‖s‖ and ‖s_trial‖."""
    rate, dt = 2.0, 1e-4
    points = material_points(HerschelBulkley(E, NU, 100.0, 50.0), 1)
    f = np.array([[[1.0, rate * dt, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]])
    for _ in range(60):
        trial = f @ points.F_e
        points.step(f, dt)
    flow = rate * dt / math.sqrt(2.0)
    lost = (energy(trial) - energy(points.F_e))[0]
    assert lost == pytest.approx((152.360336 + MU * flow) * flow, rel=1e-3)


@pytest.mark.parametrize("eta", [0.0, 5.0, 500.0])
def test_relaxation(eta, precision, tolerance, invariants):
    """At rest, ‖s‖ − √(2/3) σ_Y shrinks by 1 + 2μ̂Δt/η a step: 1e-10, at strains of order 1."""
    F = np.array([[1.2, 0.5, 0.0], [0.1, 0.9, -0.2], [0.0, 0.1, 1.1]])[None]
    sigma_Y, steps = 1e5, 12
    tau = drive(HerschelBulkley(E, NU, sigma_Y, eta), np.tile(F, (steps, 1, 1)), DT, precision)
    decay = eta / (eta + 2.0 * MU * DT)
    pressure, _, size = trial_stress(F)
    trace, s = invariants(tau)
    expected = radius(sigma_Y) + (size[0] - radius(sigma_Y)) * decay ** np.arange(1, steps + 1)
    np.testing.assert_allclose(s, expected, rtol=0, atol=tolerance * E)
    np.testing.assert_allclose(trace / 3.0, pressure[0], rtol=0, atol=tolerance * E)


@pytest.mark.parametrize("eta", [0.0, ETA, 1e5])
def test_return(eta, deformations, precision, tolerance, material_points):
    """From rest to random F: ‖s‖ as printed along s_trial; the volume and the rotation kept."""
    F = deformations[:60]
    pressure, s, size = trial_stress(F)
    yields = size > radius(SIGMA_Y)
    assert min(yields.sum(), (~yields).sum()) > 5
    expected = (returned_size(size, SIGMA_Y, eta, DT) / size)[:, None, None] * s
    expected = expected + pressure[:, None, None] * np.eye(3)
    points = material_points(HerschelBulkley(E, NU, SIGMA_Y, eta), len(F), precision).step(F, DT)
    np.testing.assert_allclose(points.tau, expected, rtol=0, atol=tolerance * np.abs(expected).max())
    np.testing.assert_allclose(np.linalg.det(points.F_e), np.linalg.det(F), rtol=tolerance)
    np.testing.assert_allclose(rotation_of(points.F_e), rotation_of(F), rtol=0, atol=10 * tolerance)
    kept = np.abs(points.F_e - F).max((1, 2)) < 1e-7
    assert kept[~yields].all()
    assert not kept[yields].any() or eta == 1e5


def test_no_viscosity_and_no_yield_stress_is_an_inviscid_fluid(deformations, material_points):
    points = material_points(HerschelBulkley(E, NU, 0.0, 0.0), 60).step(deformations[:60])
    pressure, _, _ = trial_stress(deformations[:60])
    expected = pressure[:, None, None] * np.eye(3)
    np.testing.assert_allclose(points.tau, expected, rtol=0, atol=1e-10 * np.abs(pressure).max())


def test_large_stretch_is_returned():
    """Newton starts far off: a trial b̄ with a mean of 800 goes back to no deviator at all."""
    F = np.diag([50.0, 0.2, 0.1])[None]
    tau = drive(HerschelBulkley(E, NU, 0.0, 0.0), F, 1.0)[0]
    assert np.abs(tau).max() < 1e-10 * 800 * E


def test_objective_along_a_path(rng, rotation, precision, tolerance, material_points, invariants):
    """Q f Qᵀ at every step turns τ to Q τ Qᵀ, also if Q comes in one stroke with the first step."""
    n = 40
    Q, R = rotation(rng, n), rotation(rng, n)
    Qt, Rt = Q.transpose(0, 2, 1), R.transpose(0, 2, 1)
    law = HerschelBulkley(E, NU, 2e4, 5.0)
    plain, turned = (material_points(law, n, precision) for _ in range(2))
    for k in range(6):
        f = np.eye(3) + 0.05 * rng.normal(size=(n, 3, 3))
        plain.step(f, DT)
        turned.step(Q @ f @ (Qt if k else Rt), DT)
        bound = (k + 1) * tolerance * E  # a tolerance a step
        assert np.abs(plain.tau - plain.tau.transpose(0, 2, 1)).max() < bound
        assert np.abs(turned.tau - Q @ plain.tau @ Qt).max() < bound
    assert (invariants(plain.tau)[1] > radius(2e4)).sum() > n / 2


def test_invariants_on_random_paths(rng, material_points, invariants):
    """√(2/3) σ_Y ≤ ‖s‖ < ‖s_trial‖ where it flows, det F_e follows the volume, energy is only lost."""
    n, sigma_Y, eta = 50, 2e4, 20.0
    points = material_points(HerschelBulkley(E, NU, sigma_Y, eta), n)
    volume, flowed, rested = np.ones(n), 0, 0
    for _ in range(120):
        f = np.eye(3) + 0.01 * rng.normal(size=(n, 3, 3))
        trial = f @ points.F_e
        volume *= np.linalg.det(f)
        points.step(f, DT)
        size, s = trial_stress(trial)[2], invariants(points.tau)[1]
        flows = size > radius(sigma_Y)
        flowed, rested = flowed + flows.sum(), rested + (~flows).sum()
        np.testing.assert_allclose(s, returned_size(size, sigma_Y, eta, DT), rtol=0, atol=1e-10 * E)
        assert ((s >= radius(sigma_Y) * (1.0 - 1e-9)) & (s < size))[flows].all()
        np.testing.assert_allclose(np.linalg.det(points.F_e), volume, rtol=1e-10)
        loss = energy(trial) - energy(points.F_e)
        # What the stress that is left does on the plastic strain, up to the elastic strain beside 1.
        assert (loss >= 0.9 * s * (size - s) / (2.0 * MU))[flows].all()
        np.testing.assert_allclose(loss[~flows], 0.0, atol=1e-10 * E)
    assert min(flowed, rested) > 500


def test_inverted_point_is_not_finite(elastic_tau, material_points):
    """J = −1 has no volumetric stress: the solver has to see that something is wrong."""
    F = np.diag([1.0, 1.0, -1.0])
    law = HerschelBulkley(E, NU, SIGMA_Y, ETA)
    assert not np.isfinite(elastic_tau(law, F)).any()
    assert not np.isfinite(material_points(law, 1).step(F[None], DT).tau).any()
