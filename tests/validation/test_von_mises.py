"""Von Mises: plateaus, hardening, softening to damage (physics.md, section 3)."""

import math
from dataclasses import dataclass
from functools import partial

import numpy as np
import pytest

from nsf.errors import ConfigError
from nsf.mpm import precision_of
from nsf.mpm.materials import (
    Hencky,
    IsotropicHardening,
    VonMises,
    VonMisesHardening,
    VonMisesSoftening,
    deformation_path,
    drive,
)
from nsf.mpm.stressed import stressed

E, NU, TAU_Y = 1e6, 0.3, 2e4
ELASTIC = Hencky(E, NU)
MU, LAM = ELASTIC.mu, ELASTIC.lam

LAWS = [
    pytest.param(partial(VonMises, E, NU), id="perfect"),
    pytest.param(partial(VonMisesHardening, E, NU, hardening=0.15), id="hardening"),
    pytest.param(partial(VonMisesSoftening, E, NU, softening=5e4), id="softening"),
]


def pure_shear(a):
    """[n, 3, 3] of the strain a (eₓeᵧ + eᵧeₓ), coaxial: ‖ε̂‖ = √2 |a|."""
    F = np.tile(np.eye(3), (len(a), 1, 1))
    F[:, 0, 0] = F[:, 1, 1] = np.cosh(a)
    F[:, 0, 1] = F[:, 1, 0] = np.sinh(a)
    return F


def stretches(eps):
    """[n, 3, 3] of logarithmic strains [n, 3] along the axes."""
    return np.exp(eps)[:, :, None] * np.eye(3)


def returned(F, tau_Y):
    """F_e, τ, δγ by NumPy: ε ← ε − δγ ε̂/‖ε̂‖ where 2μ̂ ‖ε̂‖ > τ_Y."""
    U, sigma, Vt = np.linalg.svd(F)
    eps = np.log(sigma)
    trace = eps.sum(1, keepdims=True)
    size = np.linalg.norm(eps - trace / 3.0, axis=1, keepdims=True)
    flow = np.maximum(size - np.reshape(tau_Y, (-1, 1)) / (2.0 * MU), 0.0)
    eps = eps - flow * (eps - trace / 3.0) / size
    F_e = U @ stretches(eps) @ Vt
    principal = 2.0 * MU * eps + LAM * trace
    return F_e, np.einsum("pij,pj,pkj->pik", U, principal, U), flow[:, 0]


def energy(F):
    eps = np.log(np.linalg.svd(F, compute_uv=False))
    return MU * (eps**2).sum(-1) + 0.5 * LAM * eps.sum(-1) ** 2


def yield_stresses(d, q, n):
    """[n + 1] τ_Y [Pa] after 0..n steps of ‖ε̂‖ by d from the yield surface on, τ_Y ← τ_Y − 2μ̂ q δγ.

    δγ_k = d (1 + q + … + q^(k−1)): a step flows by d, and by what the last change of τ_Y left outside.
    """
    flow = d * (1.0 - q ** np.arange(1, n + 1)) / (1.0 - q)
    return TAU_Y - 2.0 * MU * q * np.concatenate([[0.0], np.cumsum(flow)])


@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_uniaxial_plateau(direction, precision, tolerance, material_points):
    """τ = diag(√1.5 τ_Y, 0, 0) at the volume that frees the sides; τ₁₁ − τ₂₂ = √1.5 τ_Y at any volume."""
    plateau = direction * math.sqrt(1.5) * TAU_Y
    volume = plateau / (3.0 * LAM + 2.0 * MU)
    e = direction * np.linspace(0.05, 0.2, 4)
    F = stretches(np.outer(e, [1.0, -0.5, -0.5]) + volume / 3.0)
    tau = material_points(VonMises(E, NU, TAU_Y), 4, precision).step(F).tau
    np.testing.assert_allclose(tau, np.tile(np.diag([plateau, 0.0, 0.0]), (4, 1, 1)), atol=tolerance * E)
    strained = drive(VonMises(E, NU, TAU_Y), stretches(np.outer(e, [1.0, 0.0, 0.0])), 1.0, precision)
    np.testing.assert_allclose(strained[:, 0, 0] - strained[:, 1, 1], plateau, rtol=0, atol=tolerance * E)


def test_shear_plateau(precision, tolerance):
    """τ₁₂ = τ_Y/√2, elastic below a = τ_Y/(2√2 μ̂)."""
    limit = TAU_Y / (2.0 * math.sqrt(2.0) * MU)
    a = np.array([0.3, 0.6, 0.999, 1.001, 2.0, 5.0, 9.0]) * limit
    tau = drive(VonMises(E, NU, TAU_Y), pure_shear(a), 1.0, precision)
    expected = np.minimum(2.0 * MU * a, TAU_Y / math.sqrt(2.0))
    np.testing.assert_allclose(tau[:, 0, 1], expected, rtol=0, atol=tolerance * E)


def test_simple_shear_plateau():
    """The same in simple shear, where the stress turns with the body: small strains of a step."""
    _, F = deformation_path("simple_shear", 0.02, 201)
    tau = drive(VonMises(E, NU, 10.0), F, 1.0)[-1]
    assert tau[0, 1] == pytest.approx(10.0 / math.sqrt(2.0), rel=1e-6)


def test_unloading_is_elastic():
    """Back by a strain within the surface: 2μ̂ a less stress, and what is left is plastic strain."""
    limit = TAU_Y / (2.0 * math.sqrt(2.0) * MU)
    tau = drive(VonMises(E, NU, TAU_Y), pure_shear(limit * np.array([4.0, 3.5, 3.0, 2.0, 1.5])), 1.0)
    plateau = TAU_Y / math.sqrt(2.0)
    np.testing.assert_allclose(tau[:, 0, 1], plateau * np.array([1.0, 0.5, 0.0, -1.0, -1.0]), atol=1e-10 * E)


@pytest.mark.parametrize("law", LAWS)
def test_return(law, deformations, precision, tolerance, material_points, invariants):
    """From rest to random F: radial, onto the surface, the volume kept; within it nothing happens."""
    F, tau_Y = deformations[:60], 4e5
    expected, tau, flow = returned(F, tau_Y)
    yields = flow > 0
    assert min(yields.sum(), (~yields).sum()) > 10
    points = material_points(law(yield_stress=tau_Y), len(F), precision).step(F)
    scale = np.abs(tau).max()
    np.testing.assert_allclose(points.F_e, expected, rtol=0, atol=tolerance)
    np.testing.assert_allclose(points.tau, tau, rtol=0, atol=tolerance * scale)
    np.testing.assert_allclose(invariants(points.tau)[1][yields], tau_Y, rtol=0, atol=tolerance * scale)
    np.testing.assert_allclose(np.linalg.det(points.F_e), np.linalg.det(F), rtol=tolerance)
    assert np.array_equal(points.F_e[~yields], F[~yields].astype(precision_of(precision).numpy))


@pytest.mark.parametrize("law", LAWS)
def test_objective_and_isotropic_along_a_path(
    law, rng, rotation, precision, tolerance, material_points, invariants
):
    """Q f Qᵀ at every step turns τ to Q τ Qᵀ, also if Q comes in one stroke with the first step."""
    n = 40
    Q, R = rotation(rng, n), rotation(rng, n)
    Qt, Rt = Q.transpose(0, 2, 1), R.transpose(0, 2, 1)
    plain, turned = (material_points(law(yield_stress=TAU_Y), n, precision) for _ in range(2))
    for k in range(6):
        f = np.eye(3) + 0.02 * rng.normal(size=(n, 3, 3))
        plain.step(f)
        turned.step(Q @ f @ (Qt if k else Rt))
        bound = (k + 1) * tolerance * E  # a tolerance a step
        assert np.abs(plain.tau - plain.tau.transpose(0, 2, 1)).max() < bound
        assert np.abs(turned.tau - Q @ plain.tau @ Qt).max() < bound
        np.testing.assert_allclose(turned.history, plain.history, rtol=0, atol=bound)
    assert (invariants(plain.tau)[1] > 0.1 * TAU_Y).sum() > n / 2


@pytest.mark.parametrize("law", LAWS)
def test_invariants_on_random_paths(law, rng, material_points, invariants):
    """‖s‖ ≤ τ_Y, det F_e follows the volume, energy lost ≥ τ_Y δγ ≥ 0, τ_Y goes one way."""
    n = 50
    material = law(yield_stress=TAU_Y)
    points = material_points(material, n)
    volume = np.ones(n)
    flowed, damaged = 0, np.zeros(n, bool)
    for _ in range(120):
        f = np.eye(3) + 0.01 * rng.normal(size=(n, 3, 3))
        trial, tau_Y = f @ points.F_e, points.history[:, 0]
        volume *= np.linalg.det(f)
        points.step(f)
        damaged |= points.history[:, 0] <= 0
        intact = ~damaged
        flow = returned(trial, np.maximum(tau_Y, 0.0))[2]
        flowed += (flow > 0).sum()
        assert (invariants(points.tau)[1] <= tau_Y * (1.0 + 1e-9))[intact].all()
        np.testing.assert_allclose(np.linalg.det(points.F_e)[intact], volume[intact], rtol=1e-10)
        loss = energy(trial) - energy(points.F_e)
        assert (loss >= tau_Y * flow - 1e-10 * E)[intact].all()
        assert (loss >= -1e-10 * E).all()
        change = points.history[:, 0] - tau_Y
        sign = {VonMises: 0, VonMisesHardening: 1, VonMisesSoftening: -1}[type(material)]
        assert (np.sign(change) == sign * (flow > 0) * ~(tau_Y <= 0)).all()
        assert not points.tau[damaged].any()
    assert flowed > 1000
    assert damaged.any() == isinstance(material, VonMisesSoftening)


@pytest.mark.parametrize("law", [VonMisesHardening, VonMisesSoftening])
def test_no_change_of_the_yield_stress_is_perfect_plasticity(law):
    _, F = deformation_path("cyclic_shear", 0.3, 80)
    assert np.array_equal(drive(law(E, NU, TAU_Y, 0.0), F, 1.0), drive(VonMises(E, NU, TAU_Y), F, 1.0))


@pytest.mark.parametrize("xi", [0.05, 0.2])
def test_hardening_step_by_step(xi, material_points, invariants):
    """The printed update, summed in closed form: ‖s‖ is τ_Y one step back, 1e-10."""
    d, n = 2e-3, 60
    expected = yield_stresses(d, -xi, n)
    a = (TAU_Y / (2.0 * MU) + d * np.arange(n + 1)) / math.sqrt(2.0)
    tau = drive(VonMisesHardening(E, NU, TAU_Y, xi), pure_shear(a), 1.0)
    np.testing.assert_allclose(invariants(tau)[1][1:], expected[:-1], rtol=1e-10)


@pytest.mark.parametrize("xi", [0.05, 0.2])
def test_hardening_slope_is_met_to_first_order(xi, invariants):
    """‖s‖ = τ_Y + 2μ̂ ξ/(1 + ξ) (‖ε̂‖ − τ_Y/(2μ̂)) as the strain step goes to zero."""
    size, errors = 0.2, []
    slope = 2.0 * MU * xi / (1.0 + xi)
    exact = TAU_Y + slope * (size - TAU_Y / (2.0 * MU))
    for n in (100, 200, 400):
        a = np.linspace(0.0, size, n + 1) / math.sqrt(2.0)
        s = invariants(drive(VonMisesHardening(E, NU, TAU_Y, xi), pure_shear(a), 1.0))[1]
        errors.append(abs(s[-1] - exact))
        assert (s[-1] - s[-2]) / (size / n) == pytest.approx(slope, rel=1e-8)
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    np.testing.assert_allclose(orders, 1.0, atol=0.15)
    assert errors[-1] < 0.01 * (exact - TAU_Y)


@pytest.mark.parametrize("theta", [2e4, 2e5])
def test_softening_and_damage_step_by_step(theta, invariants):
    """The printed update, summed in closed form, down to the step on which τ_Y ≤ 0: τ = 0 from there."""
    d, n = 4e-3, 400
    expected = yield_stresses(d, theta / (2.0 * MU), n)
    end = int((expected <= 0).argmax())
    assert 10 < end < n - 10
    a = (TAU_Y / (2.0 * MU) + d * np.arange(n + 1)) / math.sqrt(2.0)
    tau = drive(VonMisesSoftening(E, NU, TAU_Y, theta), pure_shear(a), 1.0)
    np.testing.assert_allclose(invariants(tau)[1][1:end], expected[: end - 1], rtol=0, atol=1e-10 * E)
    assert not tau[end:].any()


def test_damage_takes_a_plastic_strain_of_yield_stress_over_softening(material_points):
    """One step from rest, either side of ‖ε̂‖ = τ_Y/(2μ̂) + τ_Y/θ; the volume strain does not count."""
    theta = 5e4
    for volume in (-0.1, 0.0, 0.1):
        for factor in (1.0 - 1e-6, 1.0 + 1e-6):
            flow = factor * TAU_Y / theta
            size = TAU_Y / (2.0 * MU) + flow
            F = math.exp(volume) * pure_shear(np.array([size / math.sqrt(2.0)]))
            points = material_points(VonMisesSoftening(E, NU, TAU_Y, theta), 1).step(F)
            assert points.history[0, 0] == pytest.approx(TAU_Y - theta * flow, abs=1e-10 * E)
            assert points.tau.any() == (factor < 1)


def test_damage_is_for_good(rng, precision, material_points):
    """Nothing that follows gives stress or moves F_e, however long; the whole neighbour is untouched."""
    tear = np.array([pure_shear(np.array([2.0]))[0], 1.01 * np.eye(3)])
    points = material_points(VonMisesSoftening(E, NU, TAU_Y, 5e4), 2, precision).step(tear)
    damaged_at, intact = points.history[0, 0], points.tau[1].copy()
    assert damaged_at < 0
    assert intact[0, 0] > 0.01 * E
    for k in range(400):
        f = 3.0 ** (1 if k < 200 else -1) * (np.eye(3) + 0.3 * rng.normal(size=(3, 3)))
        points.step(np.array([f, np.eye(3)]))
    assert not points.tau[0].any()
    assert np.array_equal(points.F_e[0], np.eye(3))
    assert points.history[0, 0] == damaged_at
    np.testing.assert_allclose(points.tau[1], intact, rtol=0, atol=1e-4 * E)


@pytest.mark.parametrize("law", LAWS)
def test_nan_is_not_taken_for_damage(law, material_points):
    points = material_points(law(yield_stress=TAU_Y), 1)
    for increment in (np.full((3, 3), np.nan), np.eye(3)):
        assert np.isnan(points.step(increment).tau).all()


def test_a_torn_block_flies_apart(lattice, solver_of):
    """In the solver: all start whole and are torn; then no force acts and each half keeps its momentum."""
    X = lattice((0.9, 0.4, 0.4), (1.1, 0.6, 0.6), 0.05)
    right = X[:, 0] > 1.0
    v = np.where(right[:, None], 1.0, -1.0) * np.array([[4.0, 0.0, 0.0]])
    material = VonMisesSoftening(10.0, 0.3, 0.01, 0.01)
    solver = solver_of(X, 0.05, 0.1, 0.002, size=(2.0, 1.0, 1.0), material=material, v=v)
    assert (solver.state.numpy()["history"] == 0.01).all()
    solver.step(80)
    torn = solver.state.numpy()
    assert (torn["history"] <= 0).all()
    assert not torn["tau"].any()
    assert (torn["F_e"] == np.eye(3)).all()
    # By now the halves share no node.
    solver.step(10)
    np.testing.assert_allclose(
        solver.state.numpy()["v"][right].sum(0), torn["v"][right].sum(0), rtol=1e-12, atol=1e-12
    )


@dataclass(frozen=True)
class Linear(IsotropicHardening):
    yield_stress: float
    slope: float

    def flow_stress(self, p):
        return max(self.yield_stress + self.slope * math.pow(p, type(p)(1.0)), self.yield_stress)


RATIO = 2
TENSION = math.sqrt(1.5)  # uniaxial stress over its ‖dev τ‖


@dataclass(frozen=True)
class WithNumbers(Linear):
    def flow_stress(self, p: float) -> float:
        least = type(p)(0.0)
        return self.yield_stress + max(self.slope * p * math.pi * 0.5 / (math.pi / RATIO), least)


@pytest.mark.parametrize("law", [Linear, WithNumbers])
@pytest.mark.parametrize(("precision", "rtol"), [("fp64", 1e-12), ("fp32", 1e-3)])
def test_flow_stress_of_plastic_strain(law, precision, rtol):
    """A linear one is linear hardening, whatever the path; σ = √1.5 ‖dev τ‖ and p = √(2/3) γ."""
    _, F = deformation_path("cyclic_shear", 0.2, 201)
    laws = (
        law(E, NU, TENSION * TAU_Y, TENSION**2 * 2.0 * MU * 0.15),
        VonMisesHardening(E, NU, TAU_Y, hardening=0.15),
    )
    tau, expected = (drive(law, F, dt=1e-3, precision=precision_of(precision)) for law in laws)
    np.testing.assert_allclose(tau, expected, rtol=rtol, atol=rtol * TAU_Y)


@dataclass(frozen=True)
class Voce(IsotropicHardening):
    yield_stress: float
    saturation: float
    rate: float = 20.0

    def flow_stress(self, p):
        return self.saturation + (self.yield_stress - self.saturation) * math.exp(-self.rate * p)


def sheared(norms):
    """[P, 3, 3] stresses of these ‖dev τ‖ under a pressure."""
    tau = np.tile(-5e4 * np.eye(3), (len(norms), 1, 1))
    tau[:, 0, 1] = tau[:, 1, 0] = np.array(norms) / math.sqrt(2.0)
    return tau


def test_history_from_the_stress_holds_it():
    """The flow stress is ‖dev τ‖ where the law reaches it, else its largest: at rest where it softens."""
    norms = TAU_Y * np.array([0.0, 0.5, 1.0 + 1e-6, 1.3, 1.99])
    linear, reference = Linear(E, NU, TENSION * TAU_Y, 1e5), VonMisesHardening(E, NU, TAU_Y, hardening=0.15)
    strains = linear.history_of(sheared(norms))[:, 0] / TENSION
    stresses = [[linear.flow_stress(p) / TENSION] for p in strains]
    np.testing.assert_allclose(stresses, reference.history_of(sheared(norms)), rtol=1e-9)
    voce = Voce(E, NU, TENSION * TAU_Y, 2.0 * TENSION * TAU_Y)
    gammas = voce.history_of(sheared([*norms, 3.0 * TAU_Y]))[:, 0]
    expected = [*np.maximum(norms, TAU_Y), 2.0 * TAU_Y]
    np.testing.assert_allclose(
        [voce.flow_stress(gamma / TENSION) / TENSION for gamma in gammas], expected, rtol=1e-9
    )
    assert not gammas[:2].any()
    assert not Voce(E, NU, TENSION * TAU_Y, 0.5 * TAU_Y).history_of(sheared(norms)).any()


def test_hardened_particle_keeps_its_stress_when_taken_up(material_points):
    """A step at rest from a stress above the flow stress at rest leaves it."""
    voce, tau = Voce(E, NU, TENSION * TAU_Y, 2.0 * TENSION * TAU_Y), sheared([1.5 * TAU_Y])
    start, _ = stressed(voce, tau, np.array([MU]), np.array([LAM]))
    points = material_points(voce, 1)
    points.F_e, points.history = start["F_e"], start["history"]
    np.testing.assert_allclose(points.step(np.eye(3)).tau, tau, rtol=0, atol=1e-9 * TAU_Y)


@dataclass(frozen=True)
class NotAField(Linear):
    def flow_stress(self, p):
        return self.yield_stress + self.mu * p


@dataclass(frozen=True)
class Super(Linear):
    def flow_stress(self, p):
        return super().flow_stress(p)


@dataclass(frozen=True)
class Unnamed(Linear):
    def flow_stress(self, p):
        return self.yield_stress + wrong(p)  # noqa: F821


@dataclass(frozen=True)
class Argument(Linear):
    def flow_stress(p):
        return p


TYPED = """
class Typed(Linear):
    def flow_stress(self, p):
        return self.yield_stress + self.slope * p
"""


def typed_in_an_interpreter(*values):
    names = {"Linear": Linear, "__name__": __name__}
    exec(compile(TYPED, "<stdin>", "exec"), names)
    return names["Typed"](*values)


@pytest.mark.parametrize(
    ("law", "slope", "named"),
    [
        (NotAField, 0.0, "self.mu, which is no field"),
        (Super, 0.0, "write the whole formula"),
        (Argument, 0.0, r"def flow_stress\(self, p\)"),
        (Unnamed, 0.0, "raises NameError: .*'wrong'"),
        (Linear, "2e5", "raises TypeError"),
        (typed_in_an_interpreter, 0.0, "write the class in a file"),
        (Linear, math.nan, "positive and finite"),
    ],
)
def test_flow_stress_that_no_run_can_have(law, slope, named):
    with pytest.raises(ConfigError, match=named):
        law(E, NU, TAU_Y, slope)
