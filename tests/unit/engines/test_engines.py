"""Every engine takes the steps of the reference, wherever it says that it can; else it says why not."""

import gc
import re
import weakref
from typing import ClassVar

import numpy as np
import pytest
import torch
from typing_extensions import override

import nsf
from nsf import config, engines
from nsf.dynamics import GaussNewton, Integration, ReducedBatch, Sources, Taylor
from nsf.dynamics.latent import LatentRecord
from nsf.dynamics.step import Step
from nsf.engines import ENGINES, NAMES, Engine, Reference
from nsf.engines.modal import mirrors
from nsf.errors import ConfigError
from nsf.kinematics.fields.basis import BasisManifold
from nsf.kinematics.fields.modal import ModalRestriction
from nsf.mpm import FullOrderMPM, Solver
from nsf.pipeline import Pipeline

ANGLE = {"friction_angle": 26.0}
#: Values of the problem parameter that fields are trained on, of every scene of the paper.
SCENES = {
    "bread": "[2.0,6.0]",
    "cake": "[5.0,21.0]",
    "jelly_cube": "[0.35,0.55]",
    "metal": "[0.05,0.15]",
    "sand": "[24.0,34.0]",
    "squishy_ball": "[20.0,30.0]",
    "toothpaste": "[5.0,25.0]",
}
#: The others are slow tests, and goldens hold both engines of each.
FAST = ("sand",)
SOURCES = [Sources(stress, affine) for stress in ("field", "deformation") for affine in ("field", "none")]
WAYS = [
    *({"sources": sources} for sources in SOURCES),
    {"projector": Taylor()},
    {"projector": GaussNewton(iterations=2, tolerance=1e-9)},
    {"integration": Integration("search", 0)},
    {"dt_multiplier": 1.5},
]
OTHERS = [engine for engine in ENGINES if engine.name != "reference"]


def trained(name, folder, *more):
    """A scene of the paper, fields trained on the first steps of two simulations of it, a case between."""
    overrides = [f"scene={name}", f"scene.design.train={SCENES[name]}"]
    overrides += ["scene.steps=12", "field.modes=[6,6,6]", "field.beta=4", "field.depth=1"]
    overrides += ["trainer.steps=40", "latent_dim=3", "device=cpu", "sampler=random", *more]
    pipeline = Pipeline(config.load(overrides), lambda line: None, folder)
    pipeline.simulate(("train",))
    pipeline.train()
    return pipeline.scene, pipeline.manifold(), pipeline.scene.case(pipeline.split.box.mean(1))


@pytest.fixture(
    scope="module",
    params=[name if name in FAST else pytest.param(name, marks=pytest.mark.slow) for name in SCENES],
)
def model(request, tmp_path_factory):
    return trained(request.param, tmp_path_factory.mktemp("runs"))


@pytest.mark.parametrize("engine", OTHERS, ids=lambda engine: engine.name)
def test_every_engine_is_the_reference(engine, model):
    scene, manifold, parameters = model
    first = nsf.reduced(scene, manifold, parameters, 40, device="cpu")
    kept = {"superset": first.sets}
    taken = 0
    for way in WAYS:
        options = {"projector": GaussNewton(tolerance=1e-9), "device": "cpu"} | way
        options["sets"] = kept.get(options.get("integration", Integration()).strategy)
        one, other = (
            nsf.reduced(scene, manifold, parameters, first.samples, engine=name, **options)
            for name in ("auto", "reference")
        )
        if engine.refusal([one.setup]):
            continue
        one = ReducedBatch([one.setup], engine).runs[0]
        taken += 1
        for solver in (one, other):
            solver.step(6)
        found, expected = one.trajectory(), other.trajectory()
        moved = np.abs(np.diff(expected.xhat, axis=0)).max()
        assert moved > 1e-4, way
        np.testing.assert_allclose(found.xhat, expected.xhat, rtol=0, atol=1e-4 * moved, err_msg=str(way))
        rounding = 1e-6 * expected.residuals.max()
        np.testing.assert_allclose(found.residuals, expected.residuals, 1e-3, rounding, err_msg=str(way))
        assert found.stops == expected.stops, way
        assert one.integration_mean == other.integration_mean or "integration" not in way
    assert taken


def test_engines_agree_where_c_depends_on_the_rate(tmp_path):
    scene, manifold, parameters = trained("toothpaste", tmp_path, "field.affine=rate")
    one, other = (
        nsf.reduced(
            scene, manifold, parameters, 40, projector=GaussNewton(tolerance=1e-9), engine=name, device="cpu"
        )
        for name in ("modal", "reference")
    )
    for solver in (one, other):
        solver.step(6)
    assert manifold.takes_rate
    moved = np.abs(np.diff(other.trajectory().xhat, axis=0)).max()
    np.testing.assert_allclose(one.trajectory().xhat, other.trajectory().xhat, rtol=0, atol=1e-4 * moved)


# -- what runs, and why ---------------------------------------------------------------------------------


class Damped(GaussNewton):
    """As a reader would write it: half of each update."""

    @override
    def solve(self, at, target, xhat, weights=None):
        result = super().solve(at, target, xhat, weights)
        result.xhat = 0.5 * (xhat + result.xhat)
        return result


class Quadratic(BasisManifold):
    """A field of one's own that is nearly one of ours."""


@pytest.fixture
def reduced(chain, tiny_manifold):
    return lambda manifold=tiny_manifold, **options: nsf.reduced(
        chain.scene, manifold, ANGLE, 20, device="cpu", **options
    )


@pytest.fixture
def of_another_class(tiny_manifold):
    found = Quadratic(
        tiny_manifold.latent_dim, tiny_manifold.x_sha256, ["friction_angle"], tiny_manifold.hyperparameters
    )
    found.load_state_dict(tiny_manifold.state_dict())
    return found.requires_grad_(False)


def test_the_fastest_engine_takes_the_default(reduced):
    solver = reduced()
    assert (solver.engine, solver.together.why) == ("modal", "")


def test_a_changed_projector_falls_to_the_reference(reduced):
    solver, plain = reduced(projector=Damped()), reduced()
    assert solver.engine == "reference"
    assert solver.together.why == "projector Damped is not known to modal"
    solver.step(4)
    plain.step(4)
    assert np.abs(solver.state.xhat - plain.state.xhat).max() > 1e-3


def test_a_changed_field_falls_to_the_reference(reduced, of_another_class):
    solver = reduced(of_another_class)
    assert (solver.engine, solver.together.why) == ("reference", "manifold Quadratic is not known to modal")


def broken(*arguments, **options):
    raise RuntimeError("this is what runs")


@pytest.mark.parametrize(
    ("owner", "name"),
    [
        (GaussNewton, "solve"),
        (GaussNewton, "start"),
        (Step, "infer"),
        (Step, "project"),
        (LatentRecord, "add"),
        (ModalRestriction, "position_and_jacobian"),
    ],
    ids=lambda of: getattr(of, "__name__", of),
)
def test_what_is_edited_in_the_reference_runs(reduced, monkeypatch, owner, name):
    monkeypatch.setattr(owner, name, broken)
    solver = reduced()
    assert solver.engine == "reference"
    assert f"{owner.__module__}.{owner.__name__}.{name} was edited, and modal copies" in solver.together.why
    with pytest.raises(RuntimeError, match="this is what runs"):
        solver.step(24)
    with pytest.raises(ConfigError, match=rf"no engine can take these steps: engine modal: .*{name}"):
        reduced(engine="modal")


def test_the_text_that_is_mirrored_is_the_reference():
    """Red? See that the modal engine does what the new text says, then `make mirrors`."""
    assert mirrors.edits() == {}


def test_words_and_layout_are_no_edit(monkeypatch):
    """A docstring, a comment and a line break more are the same text to the engine."""

    def start(
        self, record: LatentRecord
    ) -> torch.Tensor:  # fmt: skip
        """In other words."""
        return record.predicted  # as before

    monkeypatch.setattr(GaussNewton, "start", start)
    assert mirrors.edits() == {}

    def start(self, record: LatentRecord) -> torch.Tensor:
        return record.now

    monkeypatch.setattr(GaussNewton, "start", start)
    assert list(mirrors.edits()) == ["nsf.dynamics.projection:GaussNewton.start"]


def test_an_engine_is_asked_for(reduced):
    solver = reduced(engine="reference")
    assert (solver.engine, solver.together.why) == ("reference", "it was asked for")
    assert reduced(engine="modal").together.why == ""
    with pytest.raises(ConfigError, match=r"engine=fast is unknown; choose one of auto, modal, reference"):
        reduced(engine="fast")
    assert NAMES == ("auto", "modal", "reference")


def test_an_engine_of_ones_own(reduced):
    class Own(Engine):
        name: ClassVar[str] = "own"

        @override
        def refusal(self, setups):
            return "" if setups[0].sources == Sources() else "it knows one sources"

        @override
        def spans(self, batch):
            return Reference().spans(batch)

    assert reduced(engine=Own()).engine == "own"
    with pytest.raises(ConfigError, match=re.escape("engine own: it knows one sources")):
        reduced(engine=Own(), sources=SOURCES[3])


def test_the_reference_steps_one_run_at_a_time(chain, tiny_manifold):
    with pytest.raises(
        ConfigError, match=r"engine reference: .* one run at a time, not 2: set deploy\.batch=1"
    ):
        engines.reduced_batch(
            chain.scene, tiny_manifold, [ANGLE, ANGLE], 20, engine="reference", device="cpu"
        )


def test_the_arrays_go_when_the_solver_goes(reduced):
    """On a device they must not wait for a collection of garbage."""
    for engine in ("modal", "reference"):
        solver = reduced(engine=engine)
        solver.step(2)
        left = weakref.ref(solver.together), weakref.ref(solver.span)
        gc.disable()
        try:
            del solver
            assert [of() for of in left] == [None, None]
        finally:
            gc.enable()


# -- one protocol ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["full_order", "modal", "reference"])
def test_every_solver_keeps_the_protocol(chain, tiny_manifold, name):
    if name == "full_order":
        solver = chain.scene.full_order(ANGLE, device="cpu")
        assert isinstance(solver, FullOrderMPM)
    else:
        solver = nsf.reduced(chain.scene, tiny_manifold, ANGLE, 20, engine=name, device="cpu")
    assert isinstance(solver, Solver)
    begin = solver.state.numpy()
    solver.step(5)
    moved = solver.state.numpy()
    assert solver.steps_taken == 5
    assert solver.time == pytest.approx(5 * solver.dt)
    assert np.abs(moved["x"] - begin["x"]).max() > 0
    assert len(solver.state) == 500
    assert solver.nbytes > 0
    solver.restart()
    assert solver.steps_taken == 0
    for key, values in solver.state.numpy().items():
        np.testing.assert_array_equal(values, begin[key], err_msg=key)
    solver.step(5)
    for key, values in solver.state.numpy().items():
        np.testing.assert_array_equal(values, moved[key], err_msg=key)
