"""From the Kirchhoff stress back to the elastic deformation that carries it."""

from functools import partial
from inspect import isabstract

import numpy as np
import pytest
import warp as wp

from nsf.errors import InstabilityError
from nsf.mpm import materials, precision_of
from nsf.mpm.materials import (
    DruckerPrager,
    FixedCorotated,
    Hencky,
    HerschelBulkley,
    Material,
    VonMises,
    VonMisesHardening,
    VonMisesSoftening,
    make_elastic_stress,
)
from nsf.mpm.stressed import stressed

E, NU = 1e6, 0.3
THIRD = 0.5 ** (1.0 / 3.0)
LAWS = [
    pytest.param(Hencky, id="hencky"),
    pytest.param(FixedCorotated, id="fixed"),
    pytest.param(partial(HerschelBulkley, yield_stress=1e9, viscosity=1.0), id="herschel-bulkley"),
    pytest.param(DruckerPrager, id="drucker-prager"),
    pytest.param(partial(VonMises, yield_stress=1.0), id="von-mises"),
    pytest.param(partial(VonMisesHardening, yield_stress=1.0, hardening=0.1), id="hardening"),
    pytest.param(partial(VonMisesSoftening, yield_stress=1.0, softening=1.0), id="softening"),
]


def stress(material, F, weakness, history):
    """τ [n, 3, 3] of F [n, 3, 3] by the law's own Warp function, E of each point times its weakness [n]."""
    fp64 = precision_of("fp64")
    law = material.functions(fp64)
    kernel = make_elastic_stress(law, fp64, material.history_size)
    vecH = wp.types.vector(length=material.history_size, dtype=wp.float64)
    tau = wp.zeros(len(F), dtype=wp.mat33d, device="cpu")
    moduli = [wp.array(m * weakness, dtype=wp.float64, device="cpu") for m in (material.mu, material.lam)]
    inputs = [
        wp.array(F, dtype=wp.mat33d, device="cpu"),
        wp.array(history, dtype=vecH, device="cpu"),
        *moduli,
    ]
    wp.launch(kernel, dim=len(F), inputs=[*inputs, tau], device="cpu")
    return tau.numpy()


@pytest.fixture
def near_identity(rng):
    return np.eye(3) + 0.08 * rng.normal(size=(300, 3, 3))


@pytest.fixture
def weakness(rng):
    return rng.uniform(0.2, 1.0, 300)


def test_every_law_is_here():
    named = {getattr(p.values[0], "func", p.values[0]) for p in LAWS}
    exported = [getattr(materials, name) for name in materials.__all__]
    laws = {
        law for law in exported if isinstance(law, type) and issubclass(law, Material) and not isabstract(law)
    }
    assert named == laws


@pytest.mark.parametrize("nu", [0.3, 0.0, -0.2, 0.49])
@pytest.mark.parametrize("law", LAWS)
def test_the_stretch_carries_the_stress(law, nu, near_identity, weakness):
    """τ(V(τ)) = τ and V = √(F Fᵀ), at each point's own moduli."""
    material = law(E, nu)
    history = material.initial_history(300)
    tau = stress(material, near_identity, weakness, history)
    tau = 0.5 * (tau + tau.transpose(0, 2, 1))
    V = material.stretch_of(tau, material.mu * weakness, material.lam * weakness)
    np.testing.assert_array_equal(np.linalg.eigvalsh(V) > 0.0, True)
    np.testing.assert_allclose(V @ V, near_identity @ near_identity.transpose(0, 2, 1), atol=1e-10)
    again = stress(material, V, weakness, history)
    assert np.abs(again - tau).max() < 1e-10 * np.abs(tau).max()


@pytest.mark.parametrize("law", LAWS)
def test_no_stress_is_no_stretch(law):
    V = law(E, NU).stretch_of(np.zeros((4, 3, 3)), np.full(4, E), np.full(4, E))
    np.testing.assert_allclose(V, np.tile(np.eye(3), (4, 1, 1)), atol=1e-14)


def test_damage(near_identity, weakness):
    """A damaged point carries nothing: it comes back unstretched, and its stress is zero again."""
    material = VonMisesSoftening(E, NU, yield_stress=1.0, softening=1.0)
    history = material.initial_history(300)
    history[::2] = 0.0
    tau = stress(material, near_identity, weakness, history)
    tau = 0.5 * (tau + tau.transpose(0, 2, 1))
    assert not tau[::2].any()
    V = material.stretch_of(tau, material.mu * weakness, material.lam * weakness)
    np.testing.assert_allclose(V[::2], np.tile(np.eye(3), (150, 1, 1)), atol=1e-14)
    again = stress(material, V, weakness, history)
    assert np.abs(again - tau).max() < 1e-10 * np.abs(tau).max()


def test_fixed_corotated_in_one_direction():
    """Without volume change in the law (λ = 0): 2μ̂ σ(σ − 1) = τ."""
    material = FixedCorotated(E, 0.0)
    tau = np.zeros((1, 3, 3))
    tau[0, 2, 2] = 2.0 * material.mu * 1.3 * 0.3
    V = material.stretch_of(tau, np.array([material.mu]), np.array([0.0]))
    np.testing.assert_allclose(V[0], np.diag([1.0, 1.0, 1.3]), atol=1e-12)


@pytest.mark.parametrize(
    ("material", "pressure", "least"),
    [
        # 2μ̂ σ(σ − 1) at J = σ³ = 1/2; κ/2 (J² − 1) at J = 0.
        pytest.param(FixedCorotated(E, 0.0), -0.6 * E, E * THIRD * (THIRD - 1.0), id="fixed"),
        pytest.param(HerschelBulkley(E, 0.0, 1.0, 1.0), -0.6 * E / 3.0, -0.5 * E / 3.0, id="foam"),
    ],
)
def test_a_stress_beyond_the_law_is_refused_or_scaled_down(material, pressure, least):
    tau = np.zeros((3, 3, 3))
    tau[1] = pressure * np.eye(3)
    moduli = np.full(3, material.mu), np.full(3, material.lam)
    with pytest.raises(InstabilityError, match="of 1 particles: particle 1 has the principal"):
        material.stretch_of(tau, *moduli)
    share = material.carried_share(tau, *moduli)
    np.testing.assert_allclose(share, [1.0, least / pressure, 1.0], rtol=1e-6)
    assert np.isfinite(material.stretch_of(share[:, None, None] * tau, *moduli)).all()


def test_stresses_of_any_kind_beyond_the_law_are_brought_within_it():
    """At the edge round-off of the principal stresses decides: some would be refused."""
    material, rng = FixedCorotated(E, NU), np.random.default_rng(0)
    raw = rng.normal(size=(2000, 3, 3))
    tau = 3.0 * E * (raw @ raw.transpose(0, 2, 1)) * -1.0
    moduli = np.full(len(tau), material.mu), np.full(len(tau), material.lam)
    carried, beyond = stressed(material, tau, *moduli)
    assert beyond > 1000
    assert np.isfinite(carried["F_e"]).all()
    shares = carried["tau"][:, 0, 0] / tau[:, 0, 0]
    of_the_edge = shares / material.carried_share(tau, *moduli)
    assert of_the_edge.max() < 1.0 + 1e-9
    assert np.median(of_the_edge) > 0.99


def test_history_from_the_stress():
    """Hardening: at least what is carried. Elsewhere: as at rest."""
    tau = np.zeros((2, 3, 3))
    tau[1, 0, 1] = tau[1, 1, 0] = 3.0  # ‖dev τ‖ = 3 √2
    tau[1] += 5.0 * np.eye(3)
    hardening = VonMisesHardening(E, NU, yield_stress=2.0, hardening=0.1)
    np.testing.assert_allclose(hardening.history_of(tau), [[2.0], [3.0 * np.sqrt(2.0)]])
    for material in (VonMises(E, NU, 2.0), VonMisesSoftening(E, NU, 2.0, 1.0), DruckerPrager(E, NU)):
        np.testing.assert_array_equal(material.history_of(tau), material.initial_history(2))
