"""Simulations that take their steps together take those of their own."""

import re
from dataclasses import replace

import numpy as np
import pytest
import torch

import nsf
import nsf.scenes
from nsf.dynamics import GaussNewton, Integration, ReducedBatch, Setup, Sources, Taylor
from nsf.engines import Modal
from nsf.errors import ConfigError, ShapeError
from nsf.kinematics.fields.basis import BasisManifold
from nsf.mpm.materials import FixedCorotated, Hencky, VonMises
from nsf.sampling import SampleSpan
from nsf.timing import StageTimer

ANGLE = "friction_angle"
ANGLES = (26.0, 22.0, 37.5)
SOURCES = [Sources(stress, affine) for stress in ("field", "deformation") for affine in ("field", "none")]
#: A plate that comes down on the column within the first steps.
PLATE = [
    "+scene.colliders.plate._target_=nsf.mpm.Cuboid",
    "+scene.colliders.plate.centre=[0.5,0.5,0.31]",
    "+scene.colliders.plate.size=[0.2,0.2,0.1]",
    "+scene.colliders.plate.kind=sticky",
    "+scene.colliders.plate.motion._target_=nsf.mpm.Motion",
    "+scene.colliders.plate.motion.times=[0.0,0.12]",
    "+scene.colliders.plate.motion.translations=[[0,0,0],[0,0,-0.03]]",
]


@pytest.fixture
def parameters():
    return [{ANGLE: angle} for angle in ANGLES]


@pytest.fixture
def setup_of(tiny_manifold):
    """(scene, **options) → the setup of a run of that scene at 26°, with the sample of the first."""
    kept = {}

    def build(scene, angle=26.0, **options):
        first = (kept["samples"], kept["sets"]) if kept else (20, None)
        options = {"device": "cpu", "sets": first[1]} | options
        found = nsf.reduced(scene, tiny_manifold, {ANGLE: angle}, first[0], **options).setup
        kept.setdefault("samples", found.samples), kept.setdefault("sets", found.sets)
        return found

    return build


def together(*setups):
    return ReducedBatch(setups, Modal())


@pytest.fixture
def with_law(chain, tiny_manifold, setup_of):
    """(law, method) → the setup of a run of the tiny scene with that law."""
    first = setup_of(chain.scene)

    def build(law, sources):
        scene = replace(chain.scene, material=law, parameters={})
        options = {"sources": sources, "device": "cpu", "sets": first.sets}
        return Setup(tiny_manifold, scene, first.samples, {ANGLE: 26.0}, **options)

    return build


def same(run, single, tolerance=1e-10):
    """A run of a batch and the solver that took the same steps alone."""
    one, other = run.trajectory(), single.trajectory()
    assert np.abs(other.xhat[1:] - other.xhat[0]).max() > 0.01  # something has moved
    np.testing.assert_allclose(one.xhat, other.xhat, rtol=0, atol=tolerance)
    np.testing.assert_allclose(one.residuals, other.residuals, rtol=1e-6, atol=1e-3 * tolerance)
    assert one.stops == other.stops
    assert np.array_equal(one.t, other.t)
    assert run.integration_mean == single.integration_mean
    assert (run.time, run.sample_size) == (single.time, single.sample_size)


def assert_each_as_alone(batch, singles, steps, tolerance=1e-10):
    batch.step(steps)
    for run, single in zip(batch.runs, singles, strict=True):
        single.step(steps)
        same(run, single, tolerance)


@pytest.mark.parametrize("sources", SOURCES, ids=str)
def test_every_method(chain, tiny_manifold, parameters, sources):
    options = {"sources": sources, "device": "cpu"}
    batch = nsf.reduced_batch(chain.scene, tiny_manifold, parameters, 20, **options)
    singles = [nsf.reduced(chain.scene, tiny_manifold, own, 20, **options) for own in parameters]
    assert_each_as_alone(batch, singles, 24)
    ends = batch.xhat.numpy()
    # The friction angle enters by the heads; without it the test would show nothing.
    assert (np.abs(ends[0] - ends[1]).max() > 1e-3) == (sources.neural_stress or sources.neural_affine)


@pytest.mark.parametrize("count", [1, 8, 9, 19])
def test_tiles_that_are_full_and_not(chain, tiny_manifold, count):
    parameters = [{ANGLE: angle} for angle in np.linspace(22.0, 38.0, count)]
    batch = nsf.reduced_batch(chain.scene, tiny_manifold, parameters, 20, device="cpu")
    assert len(batch) == count
    batch.step(6)
    for index in {0, count // 2, count - 1}:
        single = nsf.reduced(chain.scene, tiny_manifold, parameters[index], 20, device="cpu")
        single.step(6)
        same(batch.runs[index], single)


@pytest.mark.parametrize(
    "options",
    [
        {"projector": Taylor()},
        {"projector": GaussNewton(iterations=4, tolerance=1e-14)},
        {"dt_multiplier": 1.5},
        {"precision": "fp32"},
    ],
    ids=lambda options: "".join(map(str, options.values()))[:20],
)
def test_every_way_of_stepping(chain, tiny_manifold, parameters, options):
    options = {"device": "cpu"} | options
    batch = nsf.reduced_batch(chain.scene, tiny_manifold, parameters, 20, **options)
    singles = [nsf.reduced(chain.scene, tiny_manifold, own, 20, **options) for own in parameters]
    assert_each_as_alone(batch, singles, 16, 1e-10 if batch.runs[0].setup.precision.name == "fp64" else 1e-4)


def test_weights_and_spans_of_time(chain, tiny_manifold, parameters):
    weights = np.random.default_rng(0).uniform(0.1, 3.0, 20)
    phases = [SampleSpan(0.0, np.arange(0, 500, 25), weights), SampleSpan(0.5, np.arange(7, 500, 50), None)]
    batch = nsf.reduced_batch(chain.scene, tiny_manifold, parameters, phases, device="cpu")
    singles = [nsf.reduced(chain.scene, tiny_manifold, own, phases, device="cpu") for own in parameters]
    assert_each_as_alone(batch, singles, 24)


def test_deep_networks_of_several_members(chain, tiny_manifold, parameters):
    """Of random weights: the first steps say whether every layer and member is where it should be."""
    hyperparameters = tiny_manifold.hyperparameters | {"members": 3, "depth": 2, "beta": [5, 4, 3]}
    manifold = BasisManifold(4, tiny_manifold.x_sha256, [ANGLE], hyperparameters)
    learnt = {k: v for k, v in tiny_manifold.state_dict().items() if ".network." not in k}
    manifold.load_state_dict(learnt, strict=False)
    for seed, field in enumerate(manifold.fields.values()):
        field.network.initialise(torch.Generator().manual_seed(seed))
        field.scale.mul_(0.01)
    manifold.requires_grad_(False)
    batch = nsf.reduced_batch(chain.scene, manifold, parameters, 20, device="cpu")
    singles = [nsf.reduced(chain.scene, manifold, own, 20, device="cpu") for own in parameters]
    assert_each_as_alone(batch, singles, 3)


CHANGES = {
    "gravity": [{}, {"scene.gravity": [1.5, 0.0, -3.0]}, {"scene.gravity": [0.0, -2.0, -6.0]}],
    "velocity": [{}, {"scene.bodies.column.velocity": [0.2, 0.1, -0.3]}],
    "stiffness": [{}, {"material.E": 3000.0}, {"material.E": 1200.0}],
    "mass": [{}, {"scene.bodies.column.density": 320.0}],
    "floor": [{}, {"scene.colliders.floor.kind": "separate"}, {"scene.colliders.floor.normal": [0.3, 0, 1]}],
    "plate": [
        {},
        {"scene.colliders.plate.motion.translations": [[0, 0, 0], [0, 0, 0.05]]},
        {"scene.colliders.plate.until": 0.05},
    ],
    "program": [{}, {"scene.program": 1}, {"scene.program": 2}],
}
#: Gravity that is tilted and shaken anew in each run.
PROGRAMS = (
    "+scene.program=0",
    "+scene.forcing.gravity.tilt={_target_: nsf.scenes.RandomTilt, angle: 30}",
    "+scene.forcing.gravity.shake={_target_: nsf.scenes.RandomShake, acceleration: 2}",
)


@pytest.mark.parametrize(
    ("what", "sources"),
    [*((what, Sources()) for what in CHANGES), ("stiffness", Sources("deformation", "none"))],
    ids=str,
)
def test_what_a_parameter_changes_is_each_ones_own(tiny, setup_of, what, sources):
    added = {"plate": PLATE, "program": PROGRAMS}.get(what, ())
    scene = nsf.load_scene("sand", [*tiny[1:], *added])
    scenes = [scene.changed(changes) if changes else scene for changes in CHANGES[what]]
    setups = [setup_of(scene, sources=sources) for scene in scenes]
    batch, singles = together(*setups), [together(setup).runs[0] for setup in setups]
    assert_each_as_alone(batch, singles, 24)
    moved = np.abs(batch.xhat.numpy()[1:] - batch.xhat.numpy()[0]).max(1)
    # With τ from its field, the moduli have no part in a step.
    assert (moved > 1e-3).all() if what != "stiffness" or not sources.neural_stress else (moved == 0.0).all()


def test_the_history_at_rest_is_each_ones_own(with_law):
    """Without flow it decides a stress where it is zero: such a particle is damaged."""
    laws = [VonMises(E=2000.0, nu=0.2, yield_stress=value) for value in (20.0, 30.0)]
    span = together(*(with_law(law, SOURCES[3]) for law in laws)).span
    held = [a for a in span._arena._buffers if a.shape == (2 * span.size, 1)]
    assert [a.flatten().tolist() for a in held] == [[20.0] * span.size + [30.0] * span.size]


def test_initial_states_are_each_ones_own(chain, tiny_manifold):
    rng = np.random.default_rng(0)
    xhat = [None, *rng.normal(size=(2, 4))]
    velocity = [rng.normal(scale=0.1, size=(500, 3)), None, rng.normal(scale=0.1, size=(500, 3))]
    one = {ANGLE: 26.0}
    batch = nsf.reduced_batch(
        chain.scene, tiny_manifold, [one] * 3, 20, xhat=xhat, velocity=velocity, device="cpu"
    )
    singles = [
        nsf.reduced(chain.scene, tiny_manifold, one, 20, xhat=x, velocity=v, device="cpu")
        for x, v in zip(xhat, velocity, strict=True)
    ]
    np.testing.assert_array_equal(batch.runs[2].state.numpy()["v"], velocity[2])
    np.testing.assert_array_equal(batch.runs[1].state.xhat, xhat[1])
    assert_each_as_alone(batch, singles, 12)


def test_one_that_goes_astray_leaves_the_others_alone(chain, tiny_manifold):
    away = np.full(4, 0.0), np.full(4, np.nan), np.array([400.0, 0.0, 0.0, 0.0]), None
    batch = nsf.reduced_batch(chain.scene, tiny_manifold, [{ANGLE: 26.0}] * 4, 60, xhat=away, device="cpu")
    alone = nsf.reduced(chain.scene, tiny_manifold, {ANGLE: 26.0}, 60, device="cpu")
    batch.step(8)
    alone.step(8)
    assert np.array_equal(batch.runs[3].trajectory().xhat, alone.trajectory().xhat)
    assert batch.runs[3].integration_mean == alone.integration_mean
    assert np.isnan(batch.runs[1].trajectory().xhat).all()
    assert [run.left_grid() for run in batch.runs] == [-1, 1, 1, -1]


def test_each_is_asked_as_a_solver_is(chain, tiny_manifold, parameters):
    batch = nsf.reduced_batch(chain.scene, tiny_manifold, parameters, 20, device="cpu")
    single = nsf.reduced(chain.scene, tiny_manifold, parameters[2], 20, device="cpu")
    run = batch.runs[2]
    assert run.integration_mean == single.integration_mean > 20
    batch.step(5)
    timer = StageTimer("cpu")
    batch.timed_step(timer)
    assert list(timer.per_step(1)) == ["inference", "p2g", "g2p", "inversion"]
    single.step(6)
    assert (run.steps_taken, batch.steps_taken, run.left_grid(), run.needed_outside()) == (6, 6, -1, 0)
    found, expected = run.state.numpy(), single.state.numpy()
    for name, values in expected.items():
        np.testing.assert_allclose(found[name], values, rtol=1e-9, atol=1e-9)
    assert run.trajectory().xhat.shape == (7, 4)
    with pytest.raises(ConfigError, match=re.escape("6 + 19 steps pass the end of the scene, 24 steps")):
        batch.step(19)


def test_a_second_run_is_as_the_first(tiny, tiny_manifold, parameters):
    scene = nsf.load_scene("sand", [*tiny[1:], *PLATE])
    sample = [SampleSpan(0.0, np.arange(0, 500, 25)), SampleSpan(0.5, np.arange(7, 500, 50))]
    batch = nsf.reduced_batch(scene, tiny_manifold, parameters, sample, device="cpu")
    single = nsf.reduced(scene, tiny_manifold, parameters[0], sample, device="cpu")
    for solver, runs in ((batch, batch.runs), (single, (single,))):
        solver.step(24)
        before = [run.record.xhat.clone() for run in runs]
        solver.restart()
        assert {run.steps_taken for run in runs} == {0}
        solver.step(24)
        assert all(torch.equal(run.record.xhat, xhat) for run, xhat in zip(runs, before, strict=True))


def test_modes_are_held_once(chain, tiny_manifold):
    def nbytes(count):
        return nsf.reduced_batch(chain.scene, tiny_manifold, [{ANGLE: 26.0}] * count, 20, device="cpu").nbytes

    one, two, three = (nbytes(count) for count in (1, 2, 3))
    assert three - two == two - one < 0.6 * one


# -- what is refused ------------------------------------------------------------------------------------


class Own(GaussNewton):
    pass


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"projector": Own()},
            "projector Own is not known to modal; engine reference: it evaluates fields for one run",
        ),
        ({"integration": Integration("search")}, "integration=search needs a whole grid for each of 3 runs"),
        ({"xhat": [None]}, "xhat is given for 1 of 3 runs"),
    ],
)
def test_what_cannot_be_stepped_together(chain, tiny_manifold, parameters, options, message):
    with pytest.raises(ConfigError, match=re.escape(message)):
        nsf.reduced_batch(chain.scene, tiny_manifold, parameters, 20, device="cpu", **options)


@pytest.mark.parametrize(
    ("overrides", "options", "message"),
    [
        (["scene.dt=0.004"], {}, "runs of a batch share Δt or the number of steps, which differs"),
        (["scene.walls.padding=4"], {}, "share the domain's walls"),
        (["scene.dx=0.025"], {"sets": None}, "share the grid"),
        (PLATE, {}, "share the number of colliders, which differs between friction_angle=26 and"),
        ([], {"sources": SOURCES[1]}, "share where τ and C come from"),
        ([], {"precision": "fp32"}, "share the precision"),
        ([], {"projector": Taylor()}, "share the projector"),
        (["transfer=pic"], {}, "share the transfer"),
    ],
)  # fmt: skip
def test_what_must_be_the_same(tiny, tiny_scene, setup_of, overrides, options, message):
    other = nsf.load_scene("sand", [*tiny[1:], *overrides]) if overrides else tiny_scene
    setups = [setup_of(tiny_scene), setup_of(other, angle=30.0, **options)]
    with pytest.raises(ConfigError, match=re.escape(message)) as error:
        together(*setups)
    assert "friction_angle=30" in str(error.value)


def test_another_law_is_refused_where_it_is_asked(with_law):
    laws = [Hencky(E=2000.0, nu=0.2), FixedCorotated(E=2000.0, nu=0.2)]
    together(*(with_law(law, Sources()) for law in laws))  # with neural stress nobody asks it
    with pytest.raises(ConfigError, match="share the law"):
        together(*(with_law(law, SOURCES[3]) for law in laws))


def test_other_samples_are_refused(chain, tiny_manifold):
    setups = [
        nsf.reduced(chain.scene, tiny_manifold, {ANGLE: 26.0}, sample, device="cpu").setup
        for sample in (range(20), range(1, 21))
    ]
    with pytest.raises(ConfigError, match="share the sample"):
        together(*setups)


def test_a_batch_has_runs():
    with pytest.raises(ConfigError, match="at least one run"):
        together()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"xhat": np.zeros(3)}, "xhat must be [4], not [3]"),
        ({"velocity": np.zeros(3)}, "velocity must be [500, 3]"),
    ],
)
def test_bad_states(setup_of, chain, options, message):
    with pytest.raises(ShapeError, match=re.escape(message)):
        setup_of(chain.scene, **options)


@pytest.mark.gpu
@pytest.mark.parametrize("sources", SOURCES, ids=str)
@pytest.mark.parametrize("count", [3, 19])
@pytest.mark.parametrize("precision", ["fp64", "fp32"])
def test_on_a_gpu(tiny_scene, reference_manifold, sources, count, precision):
    parameters = [{ANGLE: angle} for angle in np.linspace(22.0, 38.0, count)]
    options = {"sources": sources, "device": "cuda", "precision": precision}
    batch = nsf.reduced_batch(tiny_scene, reference_manifold, parameters, 60, **options)
    batch.step(24)
    for index in {0, 1, count - 1}:
        single = nsf.reduced(tiny_scene, reference_manifold, parameters[index], 60, **options)
        single.step(24)
        if precision == "fp64":
            same(batch.runs[index], single, 1e-7)  # of a GPU's sums the order is not fixed
        else:
            one, other = (run.trajectory().xhat for run in (batch.runs[index], single))
            np.testing.assert_allclose(one, other, rtol=0, atol=2e-3)


@pytest.mark.parametrize("engine", ["reference", "modal"])
def test_a_hand_is_a_program_known_only_afterwards(tiny, tiny_manifold, engine):
    """Gravity set by hand between steps gives the run whose keyframes had it all along."""
    scene = nsf.load_scene("sand", [*tiny[1:], *PROGRAMS])
    run = nsf.reduced(scene, tiny_manifold, sample=20, engine=engine, device="cpu")
    run.step(24)
    own = run.trajectory().xhat.copy()
    run.restart()
    for n in range(24):
        run.forcing.gravity = scene.acting_gravity.at(n * run.dt)
        run.step()
    np.testing.assert_allclose(run.trajectory().xhat, own, rtol=0, atol=1e-10)
    run.restart()
    run.forcing.gravity = (0.0, 0.0, -4.0)
    run.step(24)
    still = nsf.load_scene("sand", tiny[1:])
    plain = nsf.reduced(still, tiny_manifold, sample=20, engine=engine, device="cpu")
    plain.step(24)
    np.testing.assert_allclose(run.trajectory().xhat, plain.trajectory().xhat, rtol=0, atol=1e-10)
    assert np.abs(plain.trajectory().xhat - own).max() > 1e-3


def test_the_hand_of_one_run_leaves_the_others(tiny, tiny_manifold):
    scene = nsf.load_scene("sand", [*tiny[1:], *PROGRAMS])
    cases = [{"friction_angle": 26.0, "program": program} for program in (3, 4)]
    batch = nsf.reduced_batch(scene, tiny_manifold, cases, 20, engine="modal", device="cpu")
    alone = [nsf.reduced(scene, tiny_manifold, case, 20, engine="modal", device="cpu") for case in cases]
    for run in (batch.runs[0], alone[0]):
        run.together.step(8)
        run.forcing.gravity = (1.0, 0.0, -2.0)
        run.together.step(16)
    alone[1].step(24)
    for run, single in zip(batch.runs, alone, strict=True):
        np.testing.assert_allclose(run.trajectory().xhat, single.trajectory().xhat, rtol=0, atol=1e-10)
