"""Programs that are designed: their gradients, their bounds, and the full-order run that follows them."""

import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
import torch

from nsf.errors import ConfigError
from nsf.inverse import Forcing, Model
from nsf.inverse.design import Moves, Tilt, design, full_order
from nsf.inverse.fit import ModelError
from nsf.inverse.observations import Observations, View
from nsf.inverse.reports.command import calibrate, sample
from nsf.inverse.reports.command import design as command
from nsf.inverse.reports.design import _warnings
from nsf.inverse.sampling import Scalars, runs
from nsf.inverse.space import Space
from nsf.mpm import Motion

ONE = {"friction_angle": 27.0, "speed": 0.2}


def seen_of(model, program, knots):
    """Targets that a program brings about: two points at two times."""
    t, points = np.array([0.08, 0.12]), model.manifold.X[[400, 480]].numpy()
    empty = Observations.of_points(t, points, np.zeros((2, 2, 3)), 1e-4)
    forcing = program.forcing(program.values(knots))
    values = View(empty, model).of_runs(model(model.tensor(ONE)[None], forcing))[0]
    return View(Observations.of_points(t, points, values.reshape(2, 2, 3).numpy(), 1e-4), model)


def test_a_tilt_turns_gravity_and_keeps_its_size(model):
    program = Tilt(model, 4.0, 3)
    values = program.values(torch.ones(1, 3, 2, dtype=torch.float64))
    np.testing.assert_allclose(values[0, 0], 0.0)
    np.testing.assert_allclose(values[0, -1], 4.0 / np.sqrt(2.0))
    gravity = program.forcing(values).gravity[0].numpy()
    np.testing.assert_allclose(np.linalg.norm(gravity, axis=1), np.linalg.norm(model.scene.gravity))
    last = gravity[-1] @ np.array(model.scene.gravity) / np.linalg.norm(gravity[-1]) ** 2
    assert np.degrees(np.arccos(last)) == pytest.approx(4.0, abs=1e-6)


def test_gradients_are_those_of_differences(model):
    program = Tilt(model, 4.0, 2)
    knots = torch.rand(1, 2, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0))

    def seen(knots):
        return model(model.tensor(ONE)[None], program.forcing(program.values(knots)))[0, -1]

    assert torch.autograd.gradcheck(seen, knots.requires_grad_(), eps=1e-4, atol=1e-7, rtol=1e-4)
    still = torch.full((1, 2, 2), 0.5, dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(seen(still).sum(), still)
    assert torch.isfinite(slope).all()
    assert slope.abs().max() > 1e-6


def test_a_target_is_reached_again(model):
    program = Tilt(model, 4.0, 2)
    knots = torch.tensor([[[0.9, 0.2], [0.3, 0.7]]], dtype=torch.float64)
    view = seen_of(model, program, knots)
    found = design(program, view, ONE)
    assert np.sqrt(found.cost / len(view.observations)) < 0.1
    np.testing.assert_allclose(found.seen, view.observations.values, atol=2e-5)
    assert np.abs(found.values).max() <= 4.0 / np.sqrt(2.0) + 1e-9
    assert found.error_bound < np.inf


def test_the_full_order_run_follows_the_program(model):
    program = Tilt(model, 4.0, 2)
    values = program.values(torch.ones(1, 2, 2, dtype=torch.float64))[0].numpy()
    upright = np.zeros_like(values)
    scenes = [program.scene(model.scene.at(model.scene.case(ONE)), v) for v in (values, upright)]
    gravity = program.forcing(torch.as_tensor(values)[None]).gravity[0].numpy()
    np.testing.assert_allclose(scenes[0].acting_gravity.at(model.t[:-1]), gravity, atol=1e-12)
    one, other = (scene.full_order(device="cpu") for scene in scenes)
    one.step(24), other.step(24)
    aside = (one.state.numpy()["x"] - other.state.numpy()["x"]).mean(0)
    assert np.hypot(*aside[:2]) > 1e-4
    case = model.scene.full_order(model.scene.case(ONE), device="cpu")
    case.step(24)
    np.testing.assert_allclose(other.state.numpy()["x"], case.state.numpy()["x"], atol=1e-12)


def test_bounds_are_refused(model):
    with pytest.raises(
        ConfigError, match=r"tilt=30° must lie above 0° and within the [45]\.\d+° that was taught"
    ):
        Tilt(model, 30.0)
    with pytest.raises(ConfigError, match="move=plate is no solid of the scene; there are floor"):
        Moves(model, ("plate",))
    with pytest.raises(ConfigError, match="move=floor follows no program in training runs"):
        Moves(model, ("floor",))


def test_a_tilt_stays_within_what_was_taught_on_every_side(model, monkeypatch):
    taught, size = model.recurrence.taught, np.linalg.norm(model.scene.gravity)
    # As where training runs tilt to one side.
    aside = replace(taught, gravity=(0.4 * taught.reach, 0.0, -float(size)))
    monkeypatch.setattr(model.recurrence, "taught", aside)
    (most,) = (float(text) for text in re.findall(r"within the ([\d.]+)°", str(refused(model))))
    program = Tilt(model, 0.99 * most, 1)
    # Its bounds are a square in the disc.
    knots = torch.tensor([[[u, v]] for u in (0.0, 1.0) for v in (0.0, 1.0)], dtype=torch.float64)
    gravity = program.forcing(program.values(knots)).gravity.numpy()
    assert np.linalg.norm(gravity - aside.gravity, axis=-1).max() <= aside.reach
    angle = np.radians(most)
    worst = size * np.array([-np.sin(angle), 0.0, -np.cos(angle)])
    assert np.linalg.norm(worst - aside.gravity) == pytest.approx(aside.reach, rel=0.01)


def refused(model):
    """The refusal of a tilt that is too large."""
    with pytest.raises(ConfigError) as told:
        Tilt(model, 90.0)
    return told.value


def test_the_command(tmp_path, deployed, model):
    words = [f"run={deployed.deployment.path}", "device=cpu", f"folder={tmp_path / 'a'}"]
    command([*words, "run_out=0.09", "tilt=5", "knots=2", "speed=0.2"])
    program, targets = (pd.read_csv(tmp_path / "a" / f"{name}.csv") for name in ("program", "targets"))
    assert len(program) == len(model.t)
    assert targets["what"].tolist() == ["run_out"]
    assert (targets["fitted"] - targets["full_order"]).abs().max() < 0.02
    for more, told in (
        (["tilt=5"], "takes target=FILE, or scalars at the end"),
        (["height=0.1"], "takes tilt=ANGLE"),
        (["height=high", "tilt=5"], "height=high is no number"),
        (["height=0.1", "tilt=5", "speed=0.1..0.2"], "must be one value"),
        (["height=0.1", "tilt=5", "speed=9"], "speed=9 goes beyond what was taught"),
    ):
        with pytest.raises(ConfigError, match=told):
            command([*words, *more])


def test_a_target_out_of_reach_is_said(tmp_path, deployed):
    words = [f"run={deployed.deployment.path}", "device=cpu", f"folder={tmp_path / 'a'}", "full_order=false"]
    told = []
    command([*words, "height=5", "tilt=5", "knots=2"], told.append)
    (tmp_path / "b").mkdir()
    (tmp_path / "b" / "mine.txt").write_text("not a report")
    with pytest.raises(ConfigError, match="is not a report"):  # before any work
        command([*words[:-2], f"folder={tmp_path / 'b'}", "height=0.1", "tilt=5"], pytest.fail)
    assert any("no program was found that reaches the targets" in line for line in told)


# -- solids that move ------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def pushed(pipeline_at, tmp_path_factory):
    """A column that a plate pushes along programs."""
    pipeline = pipeline_at(
        tmp_path_factory.mktemp("pushed") / "runs",
        "model=recurrence",
        *("model.runs=4", "model.stress=4", "model.descents=100", "model.width=24", "model.members=2"),
        "+scene.program=0",
        "trust.limit=1e6",  # a quick fit is far off
        "+scene.forcing={gravity:{},colliders:{plate:{_target_:nsf.scenes.RandomPush,direction:[1,0,0],"
        "reach:[-0.005,0.02],knots:3}}}",
        "+scene.colliders.plate={_target_:nsf.mpm.Cuboid,centre:[0.38,0.5,0.2],size:[0.1,0.3,0.14],"
        "kind:separate,friction:0.2}",
        "+scene.parameters.friction_angle.range=[22,38]",
        "scene.design={_target_:nsf.scenes.Sobol,train:4,validation:2,test:1}",
    )
    for stage in ("simulate", "train", "deploy"):
        pipeline.run(stage)
    return Model(pipeline.deployment, "cpu")


def test_a_solid_moves_as_in_training(pushed):
    program = Moves(pushed, ("plate",), 3)
    assert program.names[0].startswith("plate along (")
    axis = program.tracks["plate"].axes[0]
    np.testing.assert_allclose(np.abs(axis), [1, 0, 0], atol=1e-9)
    values = program.values(torch.ones(1, 3, 1, dtype=torch.float64))
    forcing = program.forcing(values)
    scene = program.scene(pushed.scene.at(pushed.scene.case()), values[0].numpy())
    from nsf.recurrence import collider_states

    states = collider_states(scene.solids, pushed.dt, len(pushed.t) - 1)
    np.testing.assert_allclose(forcing.solids[0], states, atol=1e-9)
    assert np.abs(states - pushed.forcing().solids.numpy()).max() > 1e-3


def test_a_solid_moves_no_faster_than_in_training(pushed):
    program = Moves(pushed, ("plate",), 24)
    trained = np.abs(np.concatenate([np.diff(run, axis=0) for run in program.tracks["plate"].shifts])).max()
    generator = torch.Generator().manual_seed(0)
    knots = torch.rand(20, 24, 1, dtype=torch.float64, generator=generator).round()
    forcing = program.forcing(program.values(knots))
    assert np.abs(np.diff(forcing.solids[..., 9:12].numpy(), axis=1)).max() <= trained * (1 + 1e-9)
    shifts = forcing.solids[..., 9:12]
    assert shifts[..., 0].max() <= max(run[:, 0].max() for run in program.tracks["plate"].shifts) + 1e-12
    # The gradient passes on from a knot to those after it.
    again = knots.mul(0.5).add(0.25).requires_grad_()
    (slope,) = torch.autograd.grad(program.values(again)[:, -1].sum(), again)
    assert (slope != 0.0).sum() > len(again)


def test_a_bound_sees_solids(pushed):
    own, mu = pushed.forcing(), {"friction_angle": 30.0}
    assert not np.isinf(pushed.error_bound(mu, own))
    states = own.solids.clone()
    plate = slice(9, 18)  # shift, angle, their changes, whether it acts
    fast = states.clone()
    fast[:, plate][:, 4] *= 20.0
    far = states.clone()
    far[:, plate][:, 0] += 0.05
    for other in (fast, far):
        forcing = Forcing(own.gravity, other)
        assert np.isinf(pushed.error_bound(mu, forcing))
    both = Forcing(own.gravity, torch.stack([states, far]))
    assert np.isinf(pushed.error_bound([[30.0], [30.0]], both)).tolist() == [False, True]


def test_runs_of_programs_ask_for_the_program(pushed, tmp_path):
    words = [f"run={pushed.run.path}", "device=cpu", f"folder={tmp_path / 'a'}"]
    with pytest.raises(
        ConfigError, match=r"the runs of .* follow programs; give the number of one, as program=3"
    ):
        sample([*words, "runs=20"])
    with pytest.raises(ConfigError, match="give the number of one, as program=3"):
        calibrate([*words, "observations=none.csv"])
    sample([*words, "runs=20", "program=1"])
    asked, first = Scalars(["height"], pushed), pd.read_csv(tmp_path / "a" / "runs.csv.gz").iloc[0]
    one = runs(pushed, np.array([[first["friction_angle"]]]), asked, pushed.forcing(program=1))
    assert first["height"] == pytest.approx(one.values[0, 0, -1], rel=1e-5)


def test_a_solid_that_turns_is_refused(pushed, monkeypatch):
    plate = pushed.scene.colliders["plate"]
    motion = Motion([0.0, 1.0], [[0.0] * 3, [0.01, 0.0, 0.0]], [0.0, 5.0], [0, 0, 1], [0.4, 0.5, 0.2])
    turning = {**pushed.scene.colliders, "plate": replace(plate, motion=motion)}
    forcing = replace(pushed.scene.forcing, colliders={})
    monkeypatch.setattr(pushed, "scene", replace(pushed.scene, colliders=turning, forcing=forcing))
    with pytest.raises(ConfigError, match="move=plate turns as well"):
        Moves(pushed, ("plate",))


def test_a_push_is_designed(pushed):
    program = Moves(pushed, ("plate",), 2)
    t, points = np.array([0.12]), pushed.manifold.X[[10, 300]].numpy()
    empty = Observations.of_points(t, points, np.zeros((1, 2, 3)), 1e-4)
    mu = {"friction_angle": 30.0}
    knots = torch.tensor([[[0.8], [0.6]]], dtype=torch.float64)
    run = pushed(pushed.tensor(mu)[None], program.forcing(program.values(knots)))
    x = View(empty, pushed).of_runs(run)[0].reshape(1, 2, 3).numpy()
    found = design(program, View(Observations.of_points(t, points, x, 1e-4), pushed), mu)
    assert np.sqrt(found.cost / 6) < 1.0
    assert full_order(program, found, mu).shape == (25, 500, 3)


def test_the_error_of_runs_that_follow_programs(pushed):
    points = pushed.manifold.X[[10, 300]].numpy()
    view = View(Observations.of_points(np.array([0.12]), points, np.zeros((1, 2, 3)), 1e-4), pushed)
    own = ModelError.of(view, pushed)
    assert own.vectors.shape == (2, 6)
    assert own.forcing.solids.shape[0] == 2
    still = ModelError(own.parameters, own.vectors)
    scale = np.full(6, 1e-3)
    moved, unmoved = (e.offsets(view, pushed, Space.of(pushed), scale).off for e in (own, still))
    assert moved.shape == (2, 1)
    assert np.abs(moved - unmoved).max() > 0.0
    assert own.deviations.max() < 0.03


@pytest.mark.parametrize(
    ("kind", "programs", "missed", "bound", "remedies"),
    [
        (Moves, {}, 9.0, 0.1, ["allow wider bounds"]),
        (Moves, {}, 9.0, np.inf, ["train with more programs", "left what was taught"]),
        (Tilt, {"tilt": 1}, 9.0, np.nan, ["allow wider bounds"]),
        (Tilt, {}, 9.0, 0.1, ["train with programs of scene.forcing.gravity"]),
        (Tilt, {}, 1.0, 0.1, ["train with programs of scene.forcing.gravity"]),
        (Tilt, {"tilt": 1}, 1.0, 0.1, []),
    ],
)
def test_warnings_of_a_design_have_one_remedy(kind, programs, missed, bound, remedies):
    program = kind.__new__(kind)
    forced = SimpleNamespace(forcing=SimpleNamespace(gravity=programs))
    program.model = SimpleNamespace(scene=forced, trust=SimpleNamespace(limit=0.2))
    warnings = _warnings(program, SimpleNamespace(error_bound=bound), missed)
    assert len(warnings) == len(remedies)
    assert all(remedy in warning for remedy, warning in zip(remedies, warnings, strict=True))
