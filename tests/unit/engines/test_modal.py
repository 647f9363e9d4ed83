"""Steps of `field=basis` in coefficients are the steps that decode every particle with torch."""

import numpy as np
import pytest
import torch
from gpu_references import SOURCES, TOLERANCES, steps, steps_of_a_cpu

import nsf
import nsf.scenes
from nsf.dynamics import GaussNewton, Integration
from nsf.engines.modal.arena import Arena
from nsf.engines.modal.projection import projection_fits
from nsf.kinematics.fields.basis import BasisManifold
from nsf.mpm import precision_of
from nsf.sampling import RandomSampler, SampleSpan
from nsf.timing import StageTimer


@pytest.fixture
def pair(chain, tiny_manifold):
    """options → the solvers of both engines, of the same fields."""

    def build(sample=20, manifold=tiny_manifold, scene=chain.scene, **options):
        def one(engine):
            return nsf.reduced(scene, manifold, {"friction_angle": 26.0}, sample, engine=engine, **options)

        options.setdefault("device", "cpu")
        # Of the default, a hundred times as much, the two ways of the last update differ visibly.
        options.setdefault("projector", GaussNewton(tolerance=1e-6))
        return one("modal"), one("reference")

    return build


def runs(solvers, steps=24):
    for solver in solvers:
        solver.step(steps)
    return [solver.trajectory() for solver in solvers]


def same(one, other, tolerance=2e-7):
    """Equal to a tolerance of the largest latent; of training they have a deviation of one."""
    largest = max(1.0, float(np.abs(other.xhat).max()))
    np.testing.assert_allclose(one.xhat, other.xhat, rtol=0, atol=tolerance * largest)
    np.testing.assert_allclose(one.residuals, other.residuals, rtol=1e-4, atol=1e-3 * tolerance)
    np.testing.assert_allclose(one.updates, other.updates, rtol=1e-4, atol=2e-6)
    assert ((one.updates > 0) == (other.updates > 0)).all()
    assert one.stops == other.stops


@pytest.mark.parametrize(("members", "depth"), [(1, 3), (3, 2), (4, 3)])
def test_deep_and_many_networks(pair, untrained, members, depth):
    """Of random weights: the first steps say whether every layer and member is where it should be."""
    same(*runs(pair(manifold=untrained(members, depth)), steps=3), tolerance=1e-6)


def test_a_latent_vector_of_one_number(pair, untrained):
    one, other = runs(pair(manifold=untrained(1, 3, latents=1)), steps=3)
    same(one, other, tolerance=1e-6)
    assert np.abs(np.diff(one.xhat[:, 0])).min() > 1e-4


@pytest.mark.parametrize("members", [1, 3])
def test_a_single_update_moves_the_coefficients_by_their_derivative(pair, untrained, members):
    """From the start of each step, which the latent vectors before it tell, to the one that was found."""
    manifold = untrained(members, 3)
    solver, _ = pair(manifold=manifold, projector=GaussNewton(tolerance=0.1))
    factors = manifold.factors("deformation", np.arange(500), dtype=torch.float64, device="cpu")

    def coefficients(xhat):
        return torch.cat([factors.leading.double() * xhat, factors.network(xhat)])

    state, r = solver.span.coefficients, manifold.latent_dim
    for n in range(4):
        start, before = solver.record.predicted.clone(), state.a[0].clone()
        solver.step()
        along = torch.autograd.functional.jacobian(coefficients, start)
        expected = coefficients(start) + along @ (solver.xhat - start)
        found, exact = state.a[0], coefficients(solver.xhat)
        for part in (slice(0, r), slice(r, None)):
            moved = float((expected - before)[part].abs().max())
            torch.testing.assert_close(found[part], expected[part], rtol=0, atol=2e-6 * moved)
        torch.testing.assert_close(state.rate[0], (found - before) / solver.dt)
        assert (expected - exact).abs().max() > 1e-4 * moved, n
    updates = solver.trajectory().updates
    assert (updates[:, 0] > 1e-3).all()
    assert (updates[:, 1:] == 0).all()


@pytest.fixture
def untrained(tiny_manifold):
    """Members, depth and r → the tiny manifold with closures and heads of random weights."""
    return lambda members, depth, latents=4: _untrained(tiny_manifold, members, depth, latents)


def _untrained(tiny_manifold, members, depth, latents):
    hyperparameters = tiny_manifold.hyperparameters | {"members": members, "depth": depth, "beta": [5, 4, 3]}
    manifold = BasisManifold(latents, tiny_manifold.x_sha256, ["friction_angle"], hyperparameters)
    learnt = {k: v for k, v in tiny_manifold.state_dict().items() if ".network." not in k}
    for name in ("training_latents", "fields.deformation.leading"):
        learnt[name] = learnt[name][..., :latents]
    manifold.load_state_dict(learnt, strict=False)
    for seed, field in enumerate(manifold.fields.values()):
        field.network.initialise(torch.Generator().manual_seed(seed))
        for name, bias in field.network.named_parameters():
            if "bias" in name:
                torch.nn.init.normal_(bias, std=0.1, generator=torch.Generator().manual_seed(seed))
        field.scale.mul_(0.01)
    return manifold.requires_grad_(False)


def test_the_default_tolerance_leaves_little_between_the_two(pair):
    """A last update moves coefficients along their derivative in one, and is decoded in the other."""
    one, other = runs(pair(projector=GaussNewton()))
    assert ((one.updates[:, 1] > 0) == (other.updates[:, 1] > 0)).all()
    assert (one.updates[:, 1] == 0).any()  # some steps end with one update
    np.testing.assert_allclose(one.xhat, other.xhat, rtol=0, atol=5e-5)


def test_one_iteration_and_none_converged(pair):
    same(*runs(pair(projector=GaussNewton(iterations=1, tolerance=1e-6))))
    same(*runs(pair(projector=GaussNewton(iterations=2, tolerance=1e-14))))


def test_one_update_is_enough_where_fields_are_linear(pair, tiny_manifold):
    """Without a closure an update misses nothing, so what it carries along is exact."""
    r = tiny_manifold.latent_dim
    hyperparameters = tiny_manifold.hyperparameters | {
        "modes": [r, *tiny_manifold.hyperparameters["modes"][1:]]
    }
    manifold = BasisManifold(r, tiny_manifold.x_sha256, ["friction_angle"], hyperparameters)
    kept = manifold.state_dict()
    for name, values in tiny_manifold.state_dict().items():
        if name in kept:
            kept[name] = values[..., :r] if kept[name].shape != values.shape else values
    manifold.load_state_dict(kept)
    solvers = pair(manifold=manifold.requires_grad_(False), projector=GaussNewton(tolerance=1.0))
    one, other = runs(solvers)
    same(one, other, tolerance=1e-9)
    assert (one.updates[:, 0] > 1e-4).all()
    assert (one.updates[:, 1:] == 0).all()


def test_weights_and_spans(pair):
    weights = np.random.default_rng(0).uniform(0.1, 3.0, 20)
    phases = [SampleSpan(0.0, np.arange(0, 500, 25), weights), SampleSpan(0.5, np.arange(7, 500, 50), None)]
    same(*runs(pair(phases)))
    same(*runs(pair(RandomSampler(20, phases=[{"start": 0.25, "size": 8}]))))


def test_more_samples_than_a_block_has_threads(pair):
    same(*runs(pair(200), steps=6))


def test_cubic_splines(tiny, pair):
    scene = nsf.load_scene("sand", [*tiny[1:], "transfer.shape=cubic"])
    same(*runs(pair(scene=scene), steps=6))


def test_samples_off_the_grid_stay(pair):
    """Neither way of stepping moves them: they count as they are."""
    away = np.array([400.0, 0.0, 0.0, 0.0])  # far enough that some particles leave
    solvers = pair(60, xhat=away)
    for solver in solvers:
        solver.step(2)
    assert solvers[0].left_grid() == 1
    one, other = (solver.trajectory() for solver in solvers)
    np.testing.assert_allclose(one.xhat[1:3], other.xhat[1:3], rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize(
    ("r", "modes", "beta", "fits"),
    [(6, 48, 48, True), (12, 48, 48, True), (6, 48, 200, False), (14, 96, 48, False)],
)
def test_what_a_block_of_a_gpu_holds(r, modes, beta, fits):
    widths = (r, 3 * beta, 3 * beta, 3 * beta, modes - r)
    assert projection_fits(precision_of("fp64"), widths, r, modes) == fits


def test_single_precision(pair):
    modal, decoded = runs(pair(precision="fp32"))
    np.testing.assert_allclose(modal.xhat, decoded.xhat, rtol=0, atol=0.02)
    # The velocity is a difference of coefficients, not of rounded positions.
    reference = runs(pair())[0]
    assert np.abs(modal.xhat - reference.xhat).max() < np.abs(decoded.xhat - reference.xhat).max()


def test_the_particles_taken_are_those_of_the_search(pair, chain):
    X = chain.scene.particles().X
    corner = np.sort(np.linalg.norm(X - X[np.argmax(X @ [1.0, 1.0, 2.0])], axis=1).argsort()[:10])
    modal, decoded = pair(corner, integration=Integration("search", 0))
    runs((modal, decoded), 12)
    assert modal.integration_mean == decoded.integration_mean < 500
    fixed, _ = pair(corner)
    assert fixed.integration_mean > len(corner)  # before a step: how many there may be
    runs((fixed,), 12)
    assert fixed.integration_mean == modal.integration_mean


@pytest.mark.parametrize("sources", SOURCES, ids=str)
@pytest.mark.parametrize("tolerance", TOLERANCES)
def test_references_are_what_a_cpu_computes(tiny_scene, reference_manifold, sources, tolerance):
    """Else what a GPU is compared with is of older code: `make gpu-references` writes it anew."""
    found = steps(tiny_scene, reference_manifold, "cpu", sources, tolerance)
    same(found, steps_of_a_cpu(sources, tolerance), tolerance=1e-9)


@pytest.mark.gpu
@pytest.mark.parametrize("sources", SOURCES, ids=str)
@pytest.mark.parametrize("half", [False, True])
@pytest.mark.parametrize("tolerance", TOLERANCES)
def test_the_gpu_takes_the_same_steps(tiny_scene, reference_manifold, sources, half, tolerance, monkeypatch):
    if not half:
        monkeypatch.setattr(
            Arena,
            "halved",
            lambda arena, table, rows: (
                arena.modes(table, rows),
                arena.hold(torch.ones(table.shape[2]), arena.real),
            ),
        )
    found = steps(tiny_scene, reference_manifold, "cuda", sources, tolerance)
    expected = steps_of_a_cpu(sources, tolerance)
    if half:
        # Late in the run x̂ grows by a tenth a step, and with it what eleven bits of a mode leave out.
        np.testing.assert_allclose(found.xhat, expected.xhat, rtol=3e-3, atol=1e-3 * np.ptp(expected.xhat))
    else:
        same(found, expected, tolerance=1e-6)


@pytest.mark.gpu
@pytest.mark.parametrize("sources", SOURCES, ids=str)
@pytest.mark.parametrize(
    ("options", "tolerance"),
    [({"precision": "fp32"}, 1e-3), ({"engine": "reference"}, 1e-6)],
    ids=["single precision", "the reference"],
)
def test_the_gpu_takes_nearly_the_same_steps(tiny_scene, reference_manifold, sources, options, tolerance):
    """In single precision as near as modes in half precision leave them."""
    found = steps(tiny_scene, reference_manifold, "cuda", sources, 1e-6, **options).xhat
    expected = steps_of_a_cpu(sources, 1e-6).xhat
    # Modes are in half precision here too.
    np.testing.assert_allclose(found, expected, rtol=3e-3, atol=tolerance * np.ptp(expected))


@pytest.mark.gpu
@pytest.mark.parametrize("phases", [(), [{"start": 0.5, "size": 20}]], ids=["one phase", "two"])
def test_steps_timed_on_the_gpu_are_steps(tiny_scene, reference_manifold, phases):
    sampler = RandomSampler(40, phases=phases)
    timed, plain = (
        nsf.reduced(tiny_scene, reference_manifold, {"friction_angle": 26.0}, sampler, device="cuda")
        for _ in range(2)
    )
    plain.step(16)
    timer = StageTimer("cuda")
    for part in (2, 10):  # so that each phase takes some steps of both kinds
        timed.step(part)
        for _ in range(2):
            timed.timed_step(timer)
    np.testing.assert_allclose(timed.xhat.cpu(), plain.xhat.cpu(), rtol=0, atol=1e-6)
    assert list(timer.milliseconds) == ["inference", "p2g", "g2p", "inversion"]
    assert min(timer.milliseconds.values()) > 0
