"""The reduced solver (paper section 5): velocities, particle sets, phases, what it refuses."""

import re

import numpy as np
import pytest
import torch
from angles import angle, rollout

import nsf
import nsf.scenes
from nsf.dynamics import (
    GaussNewton,
    Integration,
    NeighbourSearch,
    ParticleSets,
    ProjectionResult,
    ReducedMPM,
    Setup,
    Sources,
    Taylor,
)
from nsf.errors import ConfigError, NSFError, ProjectionError, SchemaError, ShapeError
from nsf.mpm import FullOrderMPM, ParticleConstants
from nsf.sampling import RandomSampler, SampleSpan
from nsf.scenes import Scene
from nsf.timing import StageTimer

ANGLE = {"friction_angle": 26.0}
SEARCH = Integration("search", 0)
#: Never converged, so that coefficients are not carried along by their derivative.
EXACT = GaussNewton(tolerance=1e-14)


@pytest.fixture(scope="module")
def corner(chain):
    """Ten sample particles close together, whose integration particles are a part of the body only."""
    X = chain.scene.particles().X
    return np.sort(np.linalg.norm(X - X[np.argmax(X @ [1.0, 1.0, 2.0])], axis=1).argsort()[:10])


@pytest.fixture
def solver_of(chain, tiny_manifold):
    """(sample, **options) → the reduced solver at 26°."""

    def build(sample=20, scene=None, **options):
        return nsf.reduced(scene or chain.scene, tiny_manifold, ANGLE, sample, device="cpu", **options)

    return build


def run(solver, steps=None):
    solver.step(steps or solver.total_steps)
    return solver.trajectory()


# -- as issue 2 spells it -------------------------------------------------------------------------------


def test_names_of_the_python_interface(chain, tiny):
    """`nsf.scenes.load` → `full_order`, `nsf.Manifold.load` → `reduced`; one piece of code steps both."""
    scene = nsf.load_scene("sand", [o for o in tiny if o != "scene=sand"])
    manifold = nsf.Manifold.load(chain.checkpoint)
    full = scene.full_order({"friction_angle": 26.0}, "fp64", "cpu")
    reduced = nsf.reduced(scene, manifold, {"friction_angle": 26.0}, 20)
    assert isinstance(full, FullOrderMPM)
    assert isinstance(reduced, ReducedMPM)

    def user_code(solver):
        start = solver.state.numpy()
        solver.step(3)
        solver.step()
        end = solver.state.numpy()
        moved = {name: end[name] - start[name] for name in ("x", "v", "C", "tau")}
        return moved, solver.time, solver.dt, solver.steps_taken, len(solver.state)

    (one, *ones), (other, *others) = user_code(full), user_code(reduced)
    assert ones == others
    assert {k: v.shape for k, v in one.items()} == {k: v.shape for k, v in other.items()}
    assert {v.dtype for v in one.values()} == {v.dtype for v in other.values()} == {np.dtype(np.float64)}
    fall = one["x"][:, 2].mean()
    assert fall < -1e-4
    assert other["x"][:, 2].mean() == pytest.approx(fall, rel=0.2)


@pytest.mark.parametrize("sample", [np.arange(30), list(range(30)), RandomSampler(30), 30], ids=type)
def test_samples_are_indices_a_number_or_a_sampler(solver_of, sample):
    assert solver_of(sample).sample_size == 30


def test_the_configured_sample_and_value_are_the_defaults(chain, tiny_manifold):
    solver = nsf.reduced(chain.scene, tiny_manifold, device="cpu")
    assert solver.sample_size == 150
    assert solver.setup.parameters.tolist() == [chain.scene.material.friction_angle]


def test_single_precision(solver_of):
    one, other = run(solver_of(precision="fp32")), run(solver_of())
    assert one.xhat.dtype == np.float32
    np.testing.assert_allclose(one.xhat, other.xhat, atol=0.02)
    assert not np.array_equal(one.xhat, other.xhat)


# -- velocities -----------------------------------------------------------------------------------------


def test_the_first_velocity_is_the_initial_one(tiny, solver_of):
    velocity = [0.3, -0.1, 0.2]
    scene = nsf.load_scene("sand", [*tiny[1:], f"scene.bodies.column.velocity={velocity}"])
    solver = solver_of(scene=scene)
    np.testing.assert_array_equal(solver.state.numpy()["v"], np.tile(velocity, (500, 1)))
    solver.stages["inference"]()
    v = solver.span.v[solver.span.in_N[0].bool()].numpy()
    assert len(v) > len(solver.sets[0].sample)
    np.testing.assert_allclose(v, np.tile(velocity, (len(v), 1)), rtol=1e-12)


def test_the_initial_velocity_moves_the_sample(tiny, solver_of):
    """Two first steps that differ in the initial velocity alone move S apart by Δt v, but for the floor."""
    still = nsf.load_scene("sand", [*tiny[1:]])
    moving = nsf.load_scene("sand", [*tiny[1:], "scene.bodies.column.velocity=[0,0,0.2]"])
    sample = np.flatnonzero(still.particles().X[:, 2] > 0.22)
    moved = []
    for scene in (still, moving):
        solver = solver_of(sample, scene=scene)
        for name, stage in solver.stages.items():
            if name != "inversion":
                stage()
        moved.append(solver.span.x[: len(sample)].numpy())
    np.testing.assert_allclose(
        moved[1] - moved[0], np.tile([0, 0, 0.2 * still.dt], (len(sample), 1)), atol=1e-12
    )


@pytest.mark.parametrize("integration", [Integration(), SEARCH], ids=["superset", "search"])
def test_afterwards_velocities_are_backward_differences(solver_of, tiny_manifold, integration):
    solver = solver_of(integration=integration, projector=EXACT)
    history = torch.as_tensor(run(solver, 6).xhat)
    x, before = (tiny_manifold.restrict().position(history[n]) for n in (6, 5))
    expected = ((x - before) / solver.dt).numpy()
    np.testing.assert_allclose(solver.state.numpy()["v"], expected, rtol=1e-9, atol=1e-10)
    solver.stages["inference"]()
    # S comes first in N, whichever way N is found.
    rows, found = solver.span.sets.sample, solver.span.v.numpy()[: solver.sample_size]
    np.testing.assert_allclose(found, expected[rows], rtol=1e-9, atol=1e-10)  # [m/s]; 5e-13 m a step


# -- time -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("multiplier", "steps"), [(1.0, 24), (1.5, 16), (2.3, 11), (0.5, 48)])
def test_the_multiplied_step_reaches_the_end(solver_of, multiplier, steps):
    solver = solver_of(dt_multiplier=multiplier)
    assert solver.total_steps == steps
    assert solver.dt == pytest.approx(multiplier * 0.005)
    latent = run(solver)
    assert len(latent.t) == len(latent.xhat) == steps + 1
    assert 24 * 0.005 - 1e-9 <= latent.t[-1] < 24 * 0.005 + solver.dt
    assert np.isfinite(latent.xhat).all()


def test_a_longer_step_follows_the_same_motion(solver_of):
    one, other = solver_of(), solver_of(dt_multiplier=1.5)
    assert run(one).t[-1] == pytest.approx(run(other).t[-1])
    ends = [solver.state.numpy()["x"] for solver in (one, other)]
    assert np.linalg.norm(ends[0] - ends[1]) < 0.2 * np.linalg.norm(ends[0] - one.setup.constants.X)


@pytest.mark.parametrize("multiplier", [0.0, -1.0, float("nan")])
def test_multipliers_out_of_range(solver_of, multiplier):
    with pytest.raises(ConfigError, match=f"dt_multiplier={multiplier} must be positive"):
        solver_of(dt_multiplier=multiplier)


def test_passing_the_end_is_refused(solver_of):
    solver = solver_of()
    solver.step(20)
    with pytest.raises(ConfigError, match=r"20 \+ 5 steps pass the end of the scene, 24 steps"):
        solver.step(5)
    assert solver.steps_taken == 20
    solver.step(4)


# -- integration particles ------------------------------------------------------------------------------


def test_search_and_superset_are_the_same_run(solver_of, corner):
    """Superset and searched N move S alike: 'there is no approximation in this step'."""
    searching, fixed = solver_of(corner, integration=SEARCH), solver_of(corner)
    one, other = run(searching), run(fixed)
    assert len(corner) < searching.integration_mean == fixed.integration_mean < fixed.span.size < 500
    assert searching.span.size == 500
    difference = searching.state.numpy()["x"] - fixed.state.numpy()["x"]
    assert np.abs(difference).max() < 1e-10
    np.testing.assert_allclose(one.xhat, other.xhat, atol=1e-8)
    assert one.stops == other.stops


def test_every_particle_takes_its_own_mass_and_volume_along(solver_of, corner, monkeypatch):
    """Masses, volumes and moduli that differ from particle to particle: a mixed-up row would show."""
    original = Scene.particles

    def uneven(self):
        c = original(self)
        mass, volume0, stiffness = np.random.default_rng(0).uniform(0.5, 1.5, (3, len(c)))
        return ParticleConstants(c.X, mass * c.mass, volume0 * c.volume0, stiffness * c.mu, stiffness * c.lam)

    even = solver_of(corner)
    monkeypatch.setattr(Scene, "particles", uneven)
    for sources in (Sources(), Sources("deformation", "none")):
        fixed = solver_of(corner, sources=sources)
        searching = solver_of(corner, sources=sources, integration=SEARCH)
        run(fixed, 8), run(searching, 8)
        x = fixed.state.numpy()["x"]
        assert np.abs(x - searching.state.numpy()["x"]).max() < 1e-10
    run(even, 8)
    assert np.abs(x - even.state.numpy()["x"]).max() > 1e-6  # otherwise the test shows nothing


def test_nothing_is_needed_outside_the_superset(solver_of, corner):
    for solver in (solver_of(corner), solver_of(), solver_of(corner, integration=SEARCH)):
        run(solver)
        assert solver.needed_outside() == 0


def drop(sets: ParticleSets, X, nearest_to) -> ParticleSets:
    """Without the integration particle (not of S) that lies nearest to a sample particle."""
    others = sets.integration[len(sets.sample) :]
    lost = others[np.linalg.norm(X[others] - X[nearest_to], axis=1).argmin()]
    return ParticleSets(sets.sample, sets.integration[sets.integration != lost], sets.nodes)


def test_a_needed_particle_outside_the_superset_is_reported(solver_of, corner, chain, monkeypatch):
    complete, X = NeighbourSearch.superset, chain.scene.particles().X

    def incomplete(self, frames, sample, margin):
        return drop(complete(self, frames, sample, margin), X, sample[0])

    searching = solver_of(corner, integration=SEARCH)
    monkeypatch.setattr(NeighbourSearch, "superset", incomplete)
    solver = solver_of(corner)
    run(solver)
    run(searching)
    assert solver.needed_outside() == 1
    assert np.abs(solver.state.numpy()["x"] - searching.state.numpy()["x"]).max() > 1e-9


def test_a_node_outside_the_superset_is_reported(solver_of, corner, monkeypatch):
    complete = NeighbourSearch.superset

    def incomplete(self, frames, sample, margin):
        sets = complete(self, frames, sample, 0)
        marked = self.no_nodes(torch.device("cpu"))
        self.mark_nodes(torch.as_tensor(chain_X[sample]), marked)
        lost = int(marked.nonzero()[0, 0])
        return ParticleSets(sets.sample, sets.integration, sets.nodes[sets.nodes != lost])

    chain_X = solver_of(corner).setup.constants.X
    monkeypatch.setattr(NeighbourSearch, "superset", incomplete)
    solver = solver_of(corner)
    run(solver, 2)
    assert solver.needed_outside() >= 1


def test_a_wider_margin_gives_a_larger_superset(solver_of, corner):
    sizes = [solver_of(corner, integration=Integration("superset", m)).integration_mean for m in (0, 1, 2)]
    assert sizes[0] < sizes[1] < sizes[2]


def test_sets_start_with_the_sample(solver_of, corner):
    sets = solver_of(corner).span.sets
    assert sets.integration[: len(corner)].tolist() == corner.tolist()
    assert len(set(sets.integration)) == len(sets.integration)
    assert (np.diff(sets.nodes) > 0).all()


# -- spans ----------------------------------------------------------------------------------------------


def test_a_change_of_span_keeps_the_velocity(solver_of):
    """A second span of the same particles changes nothing: the backward difference goes across it."""
    plain = RandomSampler(20, seed=3)
    phased = RandomSampler(20, seed=3, phases=[{"start": 0.25, "size": 20}, {"start": 0.7, "size": 20}])
    one, other = (run(solver_of(sample, projector=EXACT)) for sample in (plain, phased))
    np.testing.assert_allclose(one.xhat, other.xhat, rtol=0, atol=1e-12)


def test_spans_begin_when_they_say(solver_of):
    solver = solver_of(RandomSampler(40, phases=[{"start": 0.5, "size": 8}]))
    assert solver.sample_size == 40
    solver.step(12)
    assert solver.span.s == 40
    solver.step(1)
    assert solver.span.s == 8
    run(solver, 11)
    assert solver.needed_outside() == 0


def test_a_projector_of_ones_own_needs_all_of_one(solver_of):
    class Half:
        iterations, tolerance = 1, 0.0

        def solve(self, at, target, xhat, weights=None): ...

    with pytest.raises(ConfigError, match=r"Half is no projector: it lacks start; .*GaussNewton"):
        solver_of(20, projector=Half())


def test_every_span_needs_enough_particles(solver_of):
    with pytest.raises(ProjectionError, match=r"\|S\|=1 gives 3 equations for r=4"):
        solver_of(RandomSampler(40, phases=[{"start": 0.5, "size": 1}]))


@pytest.mark.parametrize(
    "sample", [20, RandomSampler(20, phases=[{"start": 0.25, "size": 8}])], ids=["one", "two"]
)
def test_timed_steps_are_steps(solver_of, sample):
    timed, plain = solver_of(sample), solver_of(sample)
    timer = StageTimer("cpu")
    for _ in range(10):
        timed.timed_step(timer)
    plain.step(10)
    np.testing.assert_array_equal(timed.state.xhat, plain.state.xhat)
    assert list(timer.per_step(10)) == ["inference", "p2g", "g2p", "inversion"]


# -- weights ---------------------------------------------------------------------------------------------


@pytest.fixture
def weighted_run(solver_of):
    """Weights of 20 sample particles, options → the first half of a run."""
    particles = np.arange(0, 500, 25)
    return lambda weights, **options: run(solver_of([SampleSpan(0.0, particles, weights)], **options), 12)


@pytest.mark.parametrize("projector", [GaussNewton(), Taylor()], ids=["gauss_newton", "taylor"])
def test_weights_of_one_are_no_weights(weighted_run, projector):
    one, other = (weighted_run(weights, projector=projector) for weights in (np.ones(20), None))
    for name in ("xhat", "residuals", "updates"):
        assert np.array_equal(getattr(one, name), getattr(other, name))


def test_a_common_factor_of_the_weights_changes_nothing(weighted_run):
    weights = np.random.default_rng(0).uniform(0.1, 3.0, 20)
    one, doubled, scaled = (weighted_run(c * weights) for c in (1.0, 2.0, 0.3))
    assert np.array_equal(one.xhat, doubled.xhat)
    np.testing.assert_allclose(scaled.xhat, one.xhat, rtol=0, atol=1e-10)
    np.testing.assert_allclose(scaled.residuals, one.residuals, rtol=1e-8)
    assert np.abs(one.xhat - weighted_run(None).xhat).max() > 1e-5  # otherwise the test shows nothing


@pytest.mark.parametrize(
    "weights",
    [np.ones(19), np.zeros(20), np.full(20, np.nan), -np.ones(20)],
    ids=["few", "zero", "nan", "negative"],
)
def test_weights_out_of_range(weights):
    with pytest.raises(ConfigError, match=r"weights of 20 sample particles must be as many positive numbers"):
        SampleSpan(0.0, np.arange(20), weights)


# -- records --------------------------------------------------------------------------------------------


def test_the_run_is_recorded(solver_of):
    solver = solver_of()
    latent = run(solver, 10)
    assert latent.xhat.shape == (11, 4)
    assert latent.residuals.shape == (10, 4)
    assert latent.updates.shape == (10, 3)
    assert len(latent.stops) == 10
    np.testing.assert_allclose(latent.t, np.arange(11) * 0.005)
    np.testing.assert_array_equal(latent.xhat[-1], solver.state.xhat)
    assert (latent.residuals[:, -1] <= latent.residuals[:, 0]).all()


def test_runs_are_bitwise_the_same(solver_of, corner):
    for integration in (Integration(), SEARCH):
        one, other = (run(solver_of(corner, integration=integration)) for _ in range(2))
        for name in ("xhat", "residuals", "updates"):
            assert np.array_equal(getattr(one, name), getattr(other, name))


def test_taylor(solver_of):
    one, other = run(solver_of(projector=Taylor())), run(solver_of())
    assert one.residuals.shape == (24, 2)
    assert set(one.stops) == {"max_iterations"}
    assert np.abs(one.xhat - other.xhat).max() < 0.05 * np.abs(other.xhat[-1] - other.xhat[0]).max()


class Fails:
    """A projector that gives NaN at its n-th call."""

    iterations, tolerance = 1, 1e-6

    def __init__(self, at):
        self.left = at

    start = Taylor.start

    def solve(self, at, target, xhat, weights=None):
        self.left -= 1
        result = Taylor().solve(at, target, xhat, weights)
        bad = torch.full_like(result.xhat, float("nan"))
        return result if self.left else ProjectionResult(bad, result.residuals, result.updates)


def test_divergence_names_its_step(solver_of, tiny_trust):
    run = rollout(solver_of(projector=Fails(at=4)), angle(26.0), tiny_trust)
    assert run.diverged == 4
    assert np.isposinf(run.verdict.bound[4:]).all()


# -- refusals -------------------------------------------------------------------------------------------


def test_too_small_a_sample(chain, tiny_manifold):
    for sample in (1, [7], RandomSampler(1)):
        with pytest.raises(ProjectionError) as refusal:
            nsf.reduced(chain.scene, tiny_manifold, ANGLE, sample, device="cpu")
        assert (
            str(refusal.value)
            == "|S|=1 gives 3 equations for r=4 unknowns; choose sampler.size >= 2 or latent_dim <= 3"
        )


def test_other_particles_are_refused(tiny, tiny_manifold):
    scene = nsf.load_scene("sand", [*tiny[1:], "scene.bodies.column.particles=499"])
    with pytest.raises(SchemaError, match="checkpoint made for other particles"):
        nsf.reduced(scene, tiny_manifold, ANGLE, 20, device="cpu")


def test_a_mask_is_not_taken_for_indices(chain, tiny_manifold):
    """False and True are 0 and 1: as indices they would silently choose particles 0 and 1."""
    mask = np.arange(500) % 25 == 0
    try:
        solver = nsf.reduced(chain.scene, tiny_manifold, ANGLE, mask, device="cpu")
    except NSFError:
        return
    assert solver.span.sets.sample.tolist() == np.flatnonzero(mask).tolist()


@pytest.mark.parametrize("sample", [[], [-1], [500], [0.5, 1.0], "many", 0], ids=str)
def test_samples_out_of_range(chain, tiny_manifold, sample):
    with pytest.raises(NSFError, match=r"sample|\|S\|"):
        nsf.reduced(chain.scene, tiny_manifold, ANGLE, sample, device="cpu")


def test_more_particles_than_there_are(chain, tiny_manifold):
    with pytest.raises(ConfigError, match=re.escape("sampler.size=501, but the scene has 500 particles")):
        nsf.reduced(chain.scene, tiny_manifold, ANGLE, 501, device="cpu")


def test_unknown_parameter(chain, tiny_manifold):
    with pytest.raises(ConfigError, match="no parameter 'angle'"):
        nsf.reduced(chain.scene, tiny_manifold, {"angle": 26.0}, 20, device="cpu")


def test_a_parameter_that_the_fields_need_is_missing(chain, tiny_manifold):
    samples = [SampleSpan(0.0, np.arange(20))]
    with pytest.raises(ConfigError, match=r"lack \['friction_angle'\]"):
        Setup(tiny_manifold, chain.scene, samples, {}, device="cpu")


@pytest.mark.parametrize(
    ("settings", "quoted"),
    [(("nearest", 1), "integration.strategy='nearest'"), (("superset", -1), "integration.margin=-1")],
)
def test_integration_out_of_range(settings, quoted):
    with pytest.raises(ConfigError, match=re.escape(quoted)):
        Integration(*settings)


def test_shapes_of_foreign_frames(tiny_manifold):
    with pytest.raises(ShapeError):
        tiny_manifold.encode(torch.zeros(1, 3, 3))
