"""Mass, momentum and angular momentum; what a transfer does to an affine velocity (physics.md, section 3)."""

import numpy as np
import pytest

from nsf.mpm import Transfer
from nsf.mpm.materials import FixedCorotated

DX, SPACING = 1.0 / 16.0, 1.0 / 32.0
INERTIA = {"quadratic": 1.0 / 4.0, "cubic": 1.0 / 3.0}
SHAPES = ["quadratic", "cubic"]


@pytest.fixture
def block(lattice, rng):
    """512 particles in the middle of the unit cube, off their lattice."""
    X = lattice([0.375] * 3, [0.625] * 3, SPACING)
    return X + 0.3 * SPACING * rng.uniform(-1.0, 1.0, X.shape)


@pytest.fixture
def free_body(block, solver_of, rng):
    """(transfer, gravity) → the block, stressed, with random velocity, spin and affine momentum."""

    def build(transfer, gravity=(0.0, 0.0, 0.0)):
        spin = np.cross([1.0, -2.0, 3.0], block - 0.5)
        v = np.array([0.3, 0.1, -0.2]) + spin + 0.05 * rng.normal(size=block.shape)
        solver = solver_of(
            block,
            SPACING,
            DX,
            0.002,
            density=2.0,
            material=FixedCorotated(20.0, 0.3),
            transfer=transfer,
            gravity=gravity,
            v=v,
        )
        solver.state.C.assign(rng.normal(size=(len(block), 3, 3)))
        return solver

    return build


def momenta(solver, shape):
    """Linear [3] and angular momentum [3] about the middle, and the size of their terms."""
    s, m = solver.state.numpy(), solver.constants.mass[:, None]
    # Σ_i w (x_i − x_p) × C (x_i − x_p) = D Δx² axial(C), axial_i = ε_ijk C_kj.
    axial = np.stack([s["C"][:, k, j] - s["C"][:, j, k] for j, k in ((1, 2), (2, 0), (0, 1))], -1)
    orbital = np.cross(s["x"] - 0.5, m * s["v"])
    intrinsic = m * INERTIA[shape] * DX**2 * axial
    linear = m * s["v"]
    return (
        linear.sum(0),
        (orbital + intrinsic).sum(0),
        np.abs(linear).sum(),
        np.abs(orbital).sum() + np.abs(intrinsic).sum(),
    )


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("scheme", ["pic", "apic", "rpic"])
def test_mass_and_linear_momentum(scheme, shape, free_body):
    solver = free_body(Transfer(scheme, shape, 0.5 if scheme == "rpic" else 0.0))
    before, _, size, _ = momenta(solver, shape)
    for _ in range(20):
        solver.step()
        assert solver.grid.mass.numpy().sum() == pytest.approx(solver.constants.mass.sum(), rel=1e-12)
    after = momenta(solver, shape)[0]
    assert np.abs(after - before).max() <= 1e-12 * size
    # The run was not a walk through empty space: stresses did act.
    assert np.abs(solver.state.tau.numpy()).max() > 0.1


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize(("scheme", "damping"), [("apic", 0.0), ("rpic", 0.4), ("rpic", 1.0)])
def test_angular_momentum_is_kept(scheme, damping, shape, free_body):
    """Σ x × m v + m D Δx² axial(C) to round-off with free boundaries."""
    solver = free_body(Transfer(scheme, shape, damping))
    _, before, _, size = momenta(solver, shape)
    solver.step(50)
    _, after, _, _ = momenta(solver, shape)
    assert np.abs(after - before).max() <= 1e-12 * size


@pytest.mark.parametrize("shape", SHAPES)
def test_pic_loses_angular_momentum(shape, free_body):
    """The same sum over a PIC run falls by percents: the measure can tell."""
    solver = free_body(Transfer("pic", shape))
    solver.step()  # the random C that it was given is not PIC's own
    _, before, _, _ = momenta(solver, shape)
    solver.step(50)
    _, after, _, _ = momenta(solver, shape)
    assert np.linalg.norm(after) < 0.95 * np.linalg.norm(before)


@pytest.mark.parametrize("scheme", ["pic", "apic"])
def test_gravity_adds_its_impulse(scheme, free_body):
    gravity = np.array([0.3, -0.2, -4.0])
    solver = free_body(Transfer(scheme), gravity)
    before, _, size, _ = momenta(solver, "quadratic")
    solver.step(20)
    impulse = solver.constants.mass.sum() * gravity * solver.time
    np.testing.assert_allclose(momenta(solver, "quadratic")[0] - before, impulse, rtol=0, atol=1e-12 * size)


@pytest.mark.parametrize("shape", SHAPES)
def test_virial_of_the_internal_force(shape, free_body, rng):
    """Σ_i f_i x_iᵀ = −Σ_p V⁰ τ for any stress: the force does the work of the stress."""
    solver = free_body(Transfer("apic", shape))
    tau = rng.normal(size=(len(solver.constants), 3, 3))
    s = solver.state
    s.tau.assign(tau)
    s.v.assign(np.zeros_like(solver.constants.X))
    s.C.assign(np.zeros((len(solver.constants), 3, 3)))
    solver.p2g()
    nodes = np.stack(np.unravel_index(np.arange(solver.grid.count), solver.grid.geometry.nodes), -1) * DX
    force = solver.grid.momentum.numpy() / solver.dt
    expected = -np.einsum("p,pij->ij", solver.constants.volume0, tau)
    np.testing.assert_allclose(np.einsum("ni,nj->ij", force, nodes - 0.5), expected, rtol=0, atol=1e-13)
    np.testing.assert_allclose(force.sum(0), 0.0, atol=1e-12)


@pytest.mark.parametrize("precision", ["fp64", "fp32"])
@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize(
    ("scheme", "damping", "kept"),
    [
        ("pic", 0.0, (0.0, 0.0)),
        ("apic", 0.0, (1.0, 1.0)),
        ("rpic", 0.4, (0.6, 1.0)),
        ("rpic", 1.0, (0.0, 1.0)),
    ],
)
def test_affine_velocity(scheme, damping, kept, shape, precision, block, solver_of, rng):
    """Of v = v₀ + A x, v and F survive a transfer exactly, and C keeps the scheme's shares of A."""
    A, v0 = rng.normal(size=(3, 3)), np.array([0.4, -0.3, 0.2])
    v = v0 + (block - 0.5) @ A.T
    solver = solver_of(
        block, SPACING, DX, 0.005, transfer=Transfer(scheme, shape, damping), v=v, precision=precision
    )
    solver.state.C.assign(np.tile(A, (len(block), 1, 1)))
    solver.step()
    s = solver.state.numpy()
    eps = 1e-12 if precision == "fp64" else 2e-5
    np.testing.assert_allclose(s["v"], v, rtol=0, atol=eps)
    np.testing.assert_allclose(s["x"], block + 0.005 * v, rtol=0, atol=eps)
    np.testing.assert_allclose(s["F_e"], np.tile(np.eye(3) + 0.005 * A, (len(block), 1, 1)), rtol=0, atol=eps)
    symmetric, skew = 0.5 * (A + A.T), 0.5 * (A - A.T)
    expected = kept[0] * symmetric + kept[1] * skew
    np.testing.assert_allclose(s["C"], np.tile(expected, (len(block), 1, 1)), rtol=0, atol=50 * eps)


def test_free_rotation_loses_energy_only(lattice, solver_of):
    """APIC dissipates: kinetic (affine part too) plus elastic energy of a spinning block never grows."""
    X = lattice([0.375] * 3, [0.625] * 3, SPACING)
    material = FixedCorotated(50.0, 0.3)
    solver = solver_of(X, SPACING, DX, 0.002, material=material, v=np.cross([2.0, -1.0, 4.0], X - 0.5))

    def energy():
        s, c = solver.state.numpy(), solver.constants
        sigma = np.linalg.svd(s["F_e"], compute_uv=False)
        psi = (
            material.mu * ((sigma - 1.0) ** 2).sum(1)
            + 0.5 * material.lam * (np.linalg.det(s["F_e"]) - 1.0) ** 2
        )
        affine = DX**2 / 4.0 * (s["C"] ** 2).sum((1, 2))
        return (0.5 * c.mass * ((s["v"] ** 2).sum(1) + affine) + c.volume0 * psi).sum()

    solver.step()  # C is known from the first transfer on
    values = [energy()]
    for _ in range(300):
        solver.step()
        values.append(energy())
    values = np.array(values)
    # Symplectic stepping trades energy with the springs to and fro by 3e-6 of the whole a step.
    assert (values <= 1.0001 * np.minimum.accumulate(values)).all()
    assert (values[1:] <= values[0]).all()
    assert values[-1] > 0.95 * values[0]
