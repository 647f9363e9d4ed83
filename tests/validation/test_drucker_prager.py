"""Drucker-Prager: cone, oedometer, no cohesion (physics.md, section 3)."""

import math

import numpy as np
import pytest

from nsf.mpm.materials import DruckerPrager, Hencky, deformation_path, drive

E = 1e6


def stress(material, F, precision="fp64"):
    """τ of one step from rest to each F."""
    return np.array([drive(material, f[None], 1.0, precision)[0] for f in F])


def case_of(material, F):
    """Which case each F [n, 3, 3] falls in, from the elastic trial stress."""
    eps = np.log(np.linalg.svd(F, compute_uv=False))
    trace = eps.sum(1)
    size = np.linalg.norm(eps - trace[:, None] / 3.0, axis=1)
    excess = size + material.alpha * (3.0 * material.lam + 2.0 * material.mu) * trace / (2.0 * material.mu)
    return trace, excess


@pytest.mark.parametrize(("degrees", "K"), [(20.0, 0.4903), (30.0, 1.0 / 3.0), (40.0, 0.2174)])
def test_oedometer_ratio(degrees, K, precision, tolerance):
    """On the cone τxx/τzz = (1 − sin φ)/(1 + sin φ); ν = 0.1 (elastic ratio 1/9) yields."""
    _, F = deformation_path("oedometer", 0.05, 20)
    tau = drive(DruckerPrager(E, 0.1, degrees), F, 1.0, precision)[1:]
    sine = math.sin(math.radians(degrees))
    assert (1.0 - sine) / (1.0 + sine) == pytest.approx(K, abs=5e-5)
    expected = (1.0 - sine) / (1.0 + sine)
    # In fp32 relative to E: strains of 0.3 % are what is left of F after 1.
    size = np.abs(tau[:, 2, 2]) if precision == "fp64" else E
    for axis in (0, 1):
        assert (np.abs(tau[:, axis, axis] - expected * tau[:, 2, 2]) / size).max() < tolerance


@pytest.mark.parametrize("degrees", [30.0, 40.0])
def test_oedometer_stays_elastic_where_the_elastic_ratio_is_above(degrees):
    """ν = 0.3: ν/(1 − ν) = 0.4286 exceeds both cone ratios, so the path never reaches the cone."""
    _, F = deformation_path("oedometer", 0.05, 20)
    tau = drive(DruckerPrager(E, 0.3, degrees), F, 1.0)[1:]
    np.testing.assert_allclose(tau[:, 0, 0] / tau[:, 2, 2], 0.3 / 0.7, rtol=1e-10)


@pytest.mark.parametrize("degrees", [0.0, 25.0, 45.0])
def test_cases_of_the_return(degrees, deformations, precision, tolerance, invariants):
    """Expansion → no stress; inside the cone → elastic; outside → on the cone at the trial trace."""
    material = DruckerPrager(E, 0.3, degrees)
    F = np.concatenate([deformations[:60], np.eye(3) * 0.9 + 0.02 * (deformations[:60] - np.eye(3))])
    trace, excess = case_of(material, F)
    expanding, yielding = trace > 0, (trace < 0) & (excess > 0)
    elastic = (trace < 0) & (excess < 0)
    assert expanding.sum() > 10
    assert yielding.sum() > 10
    assert elastic.sum() > 10 or degrees == 0.0

    tau, trial = stress(material, F, precision), stress(Hencky(E, 0.3), F, precision)
    assert np.abs(tau[expanding]).max() <= tolerance * E
    np.testing.assert_allclose(tau[elastic], trial[elastic], rtol=0, atol=tolerance * E)
    p, s = invariants(tau[yielding])
    np.testing.assert_allclose(s, -material.alpha * p, rtol=0, atol=tolerance * np.abs(trial).max())
    np.testing.assert_allclose(
        p, invariants(trial[yielding])[0], rtol=0, atol=tolerance * np.abs(trial).max()
    )


def test_return_is_radial(deformations, invariants):
    """The deviator keeps its direction."""
    material = DruckerPrager(E, 0.2, 30.0)
    trace, excess = case_of(material, deformations)
    F = deformations[(trace < 0) & (excess > 0)][:20]
    tau, trial = stress(material, F), stress(Hencky(E, 0.2), F)
    unit = []
    for t in (tau, trial):
        p, s = invariants(t)
        unit.append((t - p[:, None, None] / 3.0 * np.eye(3)) / s[:, None, None])
    np.testing.assert_allclose(unit[0], unit[1], rtol=0, atol=1e-9)


def test_expansion_is_forgotten():
    """Sand pulled apart is at rest there: recompressing it builds stress at once."""
    material = DruckerPrager(E, 0.2, 30.0)
    F = np.eye(3)[None] * np.array([1.1, 1.1 * 0.99])[:, None, None]
    tau = drive(material, F, 1.0)
    expected = (3.0 * material.lam + 2.0 * material.mu) * math.log(0.99)
    assert np.abs(tau[0]).max() < 1e-10 * E
    np.testing.assert_allclose(tau[1], expected * np.eye(3), rtol=0, atol=1e-10 * E)


def test_objective(deformations, rng, rotation, precision, tolerance):
    material = DruckerPrager(E, 0.2, 30.0)
    F = deformations[:60]
    Q = rotation(rng, len(F))
    tau = stress(material, F, precision)
    size = np.abs(stress(Hencky(E, 0.2), F)).max((1, 2))
    assert (np.abs(tau - tau.transpose(0, 2, 1)).max((1, 2)) / size).max() < tolerance
    turned = Q @ tau @ Q.transpose(0, 2, 1)
    assert (np.abs(stress(material, Q @ F, precision) - turned).max((1, 2)) / size).max() < tolerance


@pytest.mark.parametrize("degrees", [20.0, 30.0, 40.0])
def test_triaxial_compression_fails_at_mohr_coulomb(degrees, invariants):
    """The cone passes through σ3/σ1 = (1 − sin φ)/(1 + sin φ): α closes on that stress state."""
    sine = math.sin(math.radians(degrees))
    tau = np.diag([-(1.0 - sine), -(1.0 - sine), -(1.0 + sine)])
    trace, size = invariants(tau)
    assert size == pytest.approx(-DruckerPrager(E, 0.2, degrees).alpha * trace, rel=1e-12)
