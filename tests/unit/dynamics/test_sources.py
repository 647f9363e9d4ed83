"""The 2×2 of methods: where τ and C come from (paper section 6.1, the baseline of Chen et al. 2023a)."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

import nsf
from nsf.dynamics import Sources
from nsf.dynamics.sources import StressFromDeformation
from nsf.errors import ConfigError
from nsf.mpm import precision_of
from nsf.mpm.device import warp_device
from nsf.mpm.materials import VonMisesSoftening

ANGLE = {"friction_angle": 26.0}
SOURCES = [Sources(stress, affine) for stress in ("field", "deformation") for affine in ("field", "none")]


@pytest.fixture(params=SOURCES, ids=str)
def sources(request):
    return request.param


@pytest.fixture
def solver(chain, tiny_manifold, sources):
    return nsf.reduced(chain.scene, tiny_manifold, ANGLE, 20, sources=sources, device="cpu")


def hencky(F, mu, lam):
    """τ = U (2μ̂ log Σ + λ tr log Σ) Uᵀ, by NumPy."""
    U, sigma, _ = np.linalg.svd(F)
    log = np.log(sigma)
    principal = 2 * mu * log + lam * log.sum(1, keepdims=True)
    return np.einsum("pij,pj,pkj->pik", U, principal, U)


@pytest.mark.parametrize(
    ("stress", "affine", "said"),
    [("none", "field", "stress=none is unknown"), ("field", "particles", "particles carry both")],
)
def test_what_is_no_source(stress, affine, said):
    with pytest.raises(ConfigError, match=said):
        Sources(stress, affine)


def test_runs_to_the_end(solver):
    solver.step(solver.total_steps)
    assert np.isfinite(solver.trajectory().xhat).all()
    assert solver.state.numpy()["x"][:, 2].mean() < solver.setup.constants.X[:, 2].mean() - 1e-3


def test_stress_and_affine_on_the_particles(solver, sources, tiny_manifold):
    """What P2G gets in mid-run, against the fields and against Hencky's law of ∂g/∂X by hand."""
    solver.step(12)
    xhat = solver.xhat.clone()
    solver.stages["inference"]()
    phase = solver.span
    taken = phase.in_N[0].bool()  # the others are not evaluated
    assert taken[: phase.s].all()
    fields = tiny_manifold.restrict(particles=torch.as_tensor(phase.order)[taken])
    if sources.neural_stress:
        tau = fields.stress(xhat, torch.tensor([26.0], dtype=torch.float64)).numpy()
        tau = tau[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
    else:
        material = solver.scene.material
        tau = hencky(fields.deformation_gradient(xhat).numpy(), material.mu, material.lam)
    C = np.zeros((len(tau), 3, 3))
    if sources.neural_affine:
        C = fields.affine(xhat, torch.tensor([26.0], dtype=torch.float64)).numpy()
    scale = np.abs(tau).max()
    assert scale > 1.0
    np.testing.assert_allclose(phase.tau[taken].numpy(), tau, atol=1e-6 * scale)
    np.testing.assert_allclose(phase.C[taken].numpy(), C, atol=1e-10)
    assert (np.abs(C).max() > 1e-3) == sources.neural_affine


def test_a_law_with_history_gives_its_stress_at_rest():
    """Without flow von Mises neither yields nor is damaged: the baseline sees Hencky's law."""
    material = VonMisesSoftening(100.0, 0.3, yield_stress=0.1, softening=1.0)
    F = torch.eye(3, dtype=torch.float64) + 0.1 * torch.sin(torch.arange(36.0, dtype=torch.float64)).view(
        4, 3, 3
    )
    mu, lam = (torch.full((4,), m, dtype=torch.float64) for m in (material.mu, material.lam))
    fields = SimpleNamespace(deformation_gradient=lambda xhat: F)
    tau = StressFromDeformation(fields, material, mu, lam, precision_of("fp64"), warp_device("cpu"))(None)
    np.testing.assert_allclose(tau.numpy(), hencky(F.numpy(), material.mu, material.lam), atol=1e-8)


def test_sources_differ(chain, tiny_manifold):
    ends = []
    for sources in SOURCES:
        solver = nsf.reduced(chain.scene, tiny_manifold, ANGLE, 20, sources=sources, device="cpu")
        solver.step(solver.total_steps)
        ends.append(solver.state.xhat)
    for i, one in enumerate(ends):
        for other in ends[:i]:
            assert np.abs(one - other).max() > 1e-6


def test_the_search_gives_every_method_the_same_run(chain, tiny_manifold, sources):
    from nsf.dynamics import Integration

    X = chain.scene.particles().X
    corner = np.linalg.norm(X - X[np.argmax(X @ [1.0, 1.0, 2.0])], axis=1).argsort()[:10]
    runs = []
    for integration in (Integration(), Integration("search", 0)):
        solver = nsf.reduced(
            chain.scene, tiny_manifold, ANGLE, corner, sources=sources, integration=integration, device="cpu"
        )
        solver.step(12)
        runs.append(solver.state.numpy()["x"])
    assert np.abs(runs[0] - runs[1]).max() < 1e-10
