"""`stress=particles`: stress and C that particles carry, beside full-order steps put onto the manifold."""

import numpy as np
import pytest
import torch

import nsf
import nsf.scenes
from nsf.dynamics import GaussNewton, Setup, Sources
from nsf.engines.choice import choose
from nsf.errors import ConfigError
from nsf.sampling import SampleSpan

ANGLE = {"friction_angle": 26.0}
CARRIED = Sources("particles", "particles")
#: Never converged, so that each step takes all its iterations.
EXACT = GaussNewton(tolerance=1e-14)


@pytest.fixture
def solver_of(chain, tiny_manifold):
    """(scene, **options) → the reduced solver at 26°."""

    def build(scene=None, sample=60, **options):
        options = {"sources": CARRIED, "device": "cpu", "projector": EXACT} | options
        return nsf.reduced(scene or chain.scene, tiny_manifold, ANGLE, sample, **options)

    return build


def test_a_step_is_the_full_order_step_put_onto_the_manifold(solver_of, chain, tiny_manifold):
    """Twelve steps of the full-order solver, each followed by the projection by hand."""
    solver, full = solver_of(), chain.scene.full_order(ANGLE, device="cpu")
    S = solver.sets[0].sample
    everything = tiny_manifold.restrict()
    at_sample = tiny_manifold.restrict(particles=torch.as_tensor(S))
    xhat = before = solver.xhat.clone()
    with torch.no_grad():
        for n in range(12):
            # Where x̂ says that the particles are, which differs from X at t = 0 too, and what it says of v.
            x = everything.position(xhat)
            v = (x - everything.position(before)) / full.dt if n else torch.zeros_like(x)
            full.state.x.assign(x.numpy())
            full.state.v.assign(v.numpy())
            full.step()
            before, found = xhat, 2.0 * xhat - before
            for _ in range(20):
                position, J = at_sample.position_and_jacobian(found)
                error = torch.as_tensor(full.state.x.numpy()[S]) - position
                found = found + torch.linalg.lstsq(J.flatten(0, 1), error.flatten()[:, None]).solution[:, 0]
            xhat = found
            solver.step()
            np.testing.assert_allclose(solver.xhat, xhat, atol=1e-7)
    own = solver.span
    tau, C = full.state.tau.numpy()[own.order], full.state.C.numpy()[own.order]
    assert np.abs(tau).max() > 1.0
    np.testing.assert_allclose(own.tau.numpy(), tau, atol=1e-5 * np.abs(tau).max())
    np.testing.assert_allclose(own.C.numpy(), C, atol=1e-5 * np.abs(C).max())


def test_every_particle_is_needed(solver_of):
    solver = solver_of()
    solver.step(2)
    assert solver.integration_mean == len(solver.state)
    assert solver.needed_outside() == 0


def test_a_body_at_rest_is_free_of_stress_exactly(solver_of):
    """Whatever the field of stress says of x̂_0."""
    solver = solver_of()
    fields = solver.manifold.restrict()
    assert float(fields.stress(solver.xhat, solver.setup.parameters).abs().max()) > 0.0
    assert not solver.span.tau.any()
    assert not solver.span.C.any()


def test_it_starts_again_as_it_started(solver_of):
    solver = solver_of()
    solver.step(10)
    first = solver.xhat.clone()
    solver.restart()
    solver.step(10)
    assert torch.equal(solver.xhat, first)


def test_the_way_to_a_state_counts(solver_of):
    """Two runs in the same x̂_n and x̂_{n−1}: one came there, of the other the fields say what τ and C are."""
    came, stands = solver_of(), solver_of()
    came.step(15)
    for name in ("now", "before", "row", "xhat"):
        getattr(stands.record, name).copy_(getattr(came.record, name))
    stands.together.resume(15)
    span, fields = stands.span, stands.manifold.restrict(particles=torch.as_tensor(stands.span.order))
    said = fields.stress(stands.xhat, stands.setup.parameters)[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].view(-1, 3, 3)
    np.testing.assert_allclose(span.tau, said, atol=1e-9 * float(said.abs().max()))
    assert float((came.span.tau - span.tau).abs().max()) > 1e-3 * float(said.abs().max())
    for solver in (came, stands):
        solver.step()
    assert not torch.equal(came.xhat, stands.xhat)
    scale = float((came.record.xhat[16] - came.record.xhat[15]).abs().max())
    np.testing.assert_allclose(came.xhat, stands.xhat, atol=0.5 * scale)


def test_two_samples_in_one_run_are_refused(chain, tiny_manifold):
    spans = [SampleSpan(0.0, np.arange(30)), SampleSpan(0.5, np.arange(40))]
    setup = Setup(tiny_manifold, chain.scene, spans, ANGLE, sources=CARRIED, device="cpu")
    with pytest.raises(ConfigError, match="particles takes one sample in a run"):
        choose("auto", [setup])


@pytest.mark.parametrize(
    ("keys", "told"),
    [
        (["deploy.batch=2"], "deploy.batch=2 needs compiled steps.*; set deploy.batch=1, or stress=field"),
        (
            ["sampler=region", "sampler.phases=[{start: 0.5, size: 30}]"],
            r"2 samples in a run, and stress=particles takes one; set sampler.phases=\[\]",
        ),
    ],
    ids=lambda value: value if isinstance(value, str) else value[0],
)
def test_what_asks_for_steps_without_a_history_is_refused(pipeline_at, tmp_path, keys, told):
    with pytest.raises(ConfigError, match=told):
        pipeline_at(tmp_path, "stress=particles", "affine=particles", *keys).check()


def test_the_compiled_engine_leaves_it_to_the_reference(solver_of):
    solver = solver_of()
    assert solver.engine == "reference"
    assert "stress=particles is not known to modal" in solver.together.why


@pytest.mark.gpu
def test_a_gpu_takes_the_same_steps(tiny, reference_manifold):
    scene = nsf.load_scene("sand", tiny[1:])
    found = []
    for device in ("cpu", "cuda"):
        solver = nsf.reduced(scene, reference_manifold, ANGLE, 60, sources=CARRIED, device=device)
        solver.step(12)
        found.append(solver.xhat.cpu())
    np.testing.assert_allclose(*found, atol=1e-6)
