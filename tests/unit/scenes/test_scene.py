"""Scenes: loading, overrides, the problem parameter, what is refused."""

import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from nsf import config as configuration
from nsf import load_scene
from nsf.config.scenes import changed_scene, scene_of
from nsf.errors import ConfigError
from nsf.mpm import FP32, HalfSpace, Motion, precision_of
from nsf.mpm.materials import DruckerPrager
from nsf.mpm.solver import bytes_on_device
from nsf.scenes import Body, Box, Cylinder, Parameter, Scene
from nsf.scenes.checks import check_memory

KEY = "scene.parameters.friction_angle.key"
FEW = "scene.bodies.column.particles=300"
MANY = "scene.bodies.column.particles=1000000000"


@pytest.fixture(scope="module")
def sand():
    return load_scene("sand", [FEW])


def test_a_resampled_scene_has_as_many_particles_as_asked_for():
    ball = "{_target_: nsf.scenes.Body, shape: {_target_: nsf.scenes.Ball, centre: [0.8, 0.8, 0.8], radius: 0.05}, particles: 7, density: 1}"  # noqa: E501
    scene = load_scene("sand", [FEW, f"+scene.bodies.ball={ball}"])
    more = scene.resampled(1001)
    assert [body.particles for body in more.bodies.values()] == [978, 23]
    X = more.particles().X
    np.testing.assert_array_equal(X[:300], scene.particles().X[:300])
    np.testing.assert_array_equal(X[978:985], scene.particles().X[300:])
    with pytest.raises(ConfigError, match="particles=0"):
        scene.resampled(5)


def test_sand_is_what_its_file_says(sand):
    assert sand.name == "sand"
    assert sand.dx == pytest.approx(1.0 / 64.0)
    assert sand.material == DruckerPrager(2000.0, 0.2, 30.0)
    assert sand.gravity == (0.0, 0.0, -4.0)
    assert sand.parameters == {"friction_angle": Parameter("material.friction_angle", "°")}


def test_paper_scale():
    """Table 1: 71 363 particles of 2.5e-8 m³, Δx = 1/150, Δt = 0.002, a 16/4 split of [21°, 38.5°]."""
    paper = load_scene("sand", ["scale=paper"])
    particles = paper.particles()
    assert len(particles) == 71363
    np.testing.assert_allclose(particles.volume0, 2.5e-8, rtol=1e-3)
    assert (paper.dx, paper.dt) == pytest.approx((1.0 / 150.0, 0.002))
    assert (len(paper.split.train), len(paper.split.test)) == (16, 4)
    assert paper.split.box.tolist() == [[21.0, 38.5]]


def test_overrides():
    scene = load_scene("sand", [FEW, "scene.dt=0.003", "transfer=rpic", "transfer.damping=0.5"])
    assert (scene.dt, scene.transfer.scheme, scene.transfer.damping) == (0.003, "rpic", 0.5)
    assert scene.particle_count == 300


def test_particles(sand):
    particles, body = sand.particles(), next(iter(sand.bodies.values()))
    assert len(particles) == 300
    assert body.shape.contains(particles.X).all()
    assert particles.volume0.sum() == pytest.approx(body.shape.volume)
    assert particles.mass.sum() == pytest.approx(body.density * body.shape.volume)
    assert (particles.mu == sand.material.mu).all()
    assert (particles.lam == sand.material.lam).all()


def test_initial_velocity():
    scene = load_scene("sand", [FEW, "scene.bodies.column.velocity=[1.0, 2.0, 3.0]"])
    np.testing.assert_array_equal(scene.initial_velocity(), np.tile([1.0, 2.0, 3.0], (300, 1)))


def test_parameters_replace_the_key(sand):
    changed = sand.at({"friction_angle": 35})
    assert changed.material.friction_angle == 35.0
    assert sand.material.friction_angle == 30.0


@pytest.mark.parametrize(
    ("parameters", "quoted"),
    [
        ({"cohesion": 1.0}, "sand has no parameter 'cohesion'; there are friction_angle"),
        ({"friction_angle": float("nan")}, "friction_angle=nan must be a finite number"),
        ({"friction_angle": "30"}, "friction_angle='30' must be a finite number"),
        ({"friction_angle": 95.0}, "material.friction_angle=95.0"),
    ],
)
def test_parameters_are_refused(sand, parameters, quoted):
    with pytest.raises(ConfigError, match=re.escape(quoted)):
        sand.at(parameters)


@pytest.mark.parametrize(
    ("key", "told"),
    [
        ("material.e", "there is no 'e', but E, nu, friction_angle; name a key of the material"),
        ("scene..dx", "there is no ''"),
        ("sampler.size", "there is no 'sampler'"),
        ("scene.dx", "changes scene.dx"),
        ("scene.bodies.column.particles", "changes scene.bodies.column.particles"),
        ("scene.bodies.column.shape.radius", "changes scene.bodies.column.shape.radius"),
    ],
)
def test_a_parameter_is_of_the_physics_alone(key, told):
    with pytest.raises(ConfigError, match=re.escape(told)):
        load_scene("sand", [f"{KEY}={key}"])


@pytest.mark.parametrize("key", ["gravity.2", "bodies.column.density", "colliders.floor.friction"])
def test_a_parameter_may_be_of_any_physics(key):
    assert load_scene(
        "sand",
        [FEW, "scene.colliders.floor.kind=separate", f"{KEY}=scene.{key}"],
    )


def test_full_order_runs_at_a_parameter(sand):
    solver = sand.full_order({"friction_angle": 21.0}, device="cpu")
    assert solver.material.friction_angle == 21.0
    before = solver.state.numpy()["x"]
    solver.step(5)
    fall = solver.state.numpy()["x"] - before
    assert -0.5 * 4.0 * (6 * sand.dt) ** 2 < fall[:, 2].min() < 0.0


TILTED = [
    "scene.gravity=[0.0,0.0,4.0]",
    "+scene.inclination={_target_: nsf.scenes.Inclination, angle: 10.0, axis: [0,1,0]}",
    "~scene.parameters.friction_angle",
    "+scene.parameters.tilt={key:scene.inclination.angle,unit:'°'}",
    "scene.design.train=[10.0, 20.0]",
    "scene.design.validation=[]",
    "scene.design.test=[30.0]",
]


def test_gravity_and_velocities_turn_with_the_inclination():
    scene = load_scene("sand", [FEW, *TILTED, "scene.bodies.column.velocity=[0.0,0.0,1.0]"])
    assert scene.base_gravity[0] == pytest.approx(4.0 * np.sin(np.radians(10.0)))
    tilted = scene.at({"tilt": 30.0})
    assert tilted.acting_gravity.values[0][0] == pytest.approx(2.0)
    np.testing.assert_allclose(tilted.initial_velocity()[0], [0.5, 0.0, np.sqrt(0.75)])
    assert tilted.at({"tilt": 90.0}).base_gravity[0] == pytest.approx(4.0)


@pytest.mark.parametrize(
    "way",
    [
        [
            "+scene.down='${scene.inclination.angle}'",
            "scene.bodies.column.velocity=['${scene.down}',0.0,0.0]",
        ],
        [
            "+scene.all={angle: '${scene.inclination.angle}'}",
            "scene.bodies.column.velocity=['${scene.all.angle}',0,0]",
        ],
        ["scene.bodies.column.velocity=['${....inclination.angle}',0,0]"],
        ["scene.bodies.column.velocity=['${oc.select:scene.inclination.angle,7}',0,0]"],
    ],
    ids=["twice", "with all keys beside it", "relatively", "if it is there"],
)
def test_a_key_that_refers_to_the_parameter_is_refused(way):
    """A case replaces a value, and what refers to its key would stay as it is."""
    told = r"scene\.bodies\.column\.velocity\.0 refers to scene\.inclination\.angle, .* would not follow it"
    with pytest.raises(ConfigError, match=told):
        load_scene("sand", [FEW, *TILTED, *way])


def test_a_parameter_that_is_no_key_is_refused():
    with pytest.raises(ConfigError, match=r"scene\.tilt"):
        load_scene("sand", [FEW, f"{KEY}=scene.tilt"])


@pytest.mark.parametrize(
    ("overrides", "quoted"),
    [
        (["transfer=apicc"], "unknown transfer=apicc; choose one of apic, pic, rpic (did you mean apic?)"),
        (["scene.steps=0"], "scene.steps=0"),
        (["scene.dx=0"], "scene.dx=0"),
        (["+scene.bodies.column.particles_per_cell=8"], "particles_per_cell=8: give exactly one"),
        (["scene.gravity=[0.0, 0.0]"], "scene.gravity=[0.0, 0.0]"),
        (["scene.bodies.column.velocity=[1.0, 2.0]"], "velocity=[1.0, 2.0]"),
        (["scene.bodies.column.particles=0"], "particles=0"),
        (["scene.design.test=[21.0]"], "21°"),
    ],
)
def test_refused(overrides, quoted):
    with pytest.raises(ConfigError, match=re.escape(quoted)):
        load_scene("sand", [FEW, *overrides])


@pytest.mark.parametrize(
    ("overrides", "quoted"),
    [
        (
            ["+scene.bodies.column.weakness.factor=0.5"],
            "scene.bodies.column: weakness={'factor': 0.5} must be",
        ),
        (["~scene.bodies.column.shape._target_"], "scene.bodies.column: shape="),
        (["scene.colliders.floor.normal=[0, 0, 0]"], "scene.colliders.floor: half-space.normal=[0, 0, 0]"),
    ],
)
def test_a_refusal_names_the_node(overrides, quoted):
    with pytest.raises(ConfigError, match=re.escape(quoted)):
        load_scene("sand", [FEW, *overrides])


def test_missing_value():
    with pytest.raises(ConfigError, match="E"):
        configuration.load(["scene=sand", "material.E=???"])


GRIP = (
    "+scene.colliders.grip={_target_: nsf.mpm.Cuboid, centre: [0.5, 0.5, 0.3], size: [0.1, 0.2, 0.1],"
    " angle: 30, until: 0.3, motion: {_target_: nsf.mpm.Motion, times: [0, 0.2],"
    " translations: [[0, 0, 0], '${turned:[0.1,0,0],[0,0,1],${scene.colliders.grip.angle}}']}}"
)


def test_moving_colliders():
    """Motions nest, a direction follows an angle, and lists arrive as lists."""
    floor, grip = load_scene("sand", [FEW, GRIP]).solids
    assert isinstance(floor, HalfSpace)
    assert (grip.kind, grip.angle, grip.since, grip.until) == ("sticky", 30, 0.0, 0.3)
    assert type(grip.motion) is Motion
    assert [type(v) for v in (grip.size, grip.motion.times, grip.motion.translations)] == [list] * 3
    along = grip.motion.translations[1]
    assert type(along) is list
    np.testing.assert_allclose(along, grip.orientation[:, 0] * 0.1, atol=1e-15)


@pytest.mark.parametrize(
    ("change", "quoted"),
    [
        ("until=soon", "scene.colliders.grip.until=soon must be a number"),
        ("motion.times=[0.2,0.0]", "motion.times=[0.2, 0.0] s"),
        ("+motion.axes=[0,0,1]", "axes"),
    ],
)
def test_refused_motions(change, quoted):
    plus = "+" * change.startswith("+")
    with pytest.raises(ConfigError, match=re.escape(quoted)):
        load_scene("sand", [FEW, GRIP, f"{plus}scene.colliders.grip.{change.lstrip('+')}"])


def test_body_outside_the_domain(sand):
    with pytest.raises(ConfigError, match=r"scene\.bodies\.column: .* reaches outside the domain"):
        load_scene("sand", [FEW, "scene.bodies.column.shape.base=[0.98, 0.5, 0.13]"])


@pytest.mark.parametrize(
    ("overrides", "quoted"),
    [
        (
            ["scene.bodies.column.shape.radius=0.004", "scene.bodies.column.shape.height=0.008"],
            "smaller than a cell of scene.dx=0.015625 m in every direction",
        ),
        (["scene.bodies.column.shape.radius=1e200"], "reaches outside the domain"),
        (["scene.dx=0.0005"], "dx=0.0005 m makes 8.01e+09 grid nodes of 32 bytes (239 GiB)"),
        (["scene.dx=1e-300"], "dx=1e-300 m makes inf grid nodes"),
        (["scene.size=[1e300,1e300,1e300]"], "makes inf grid nodes"),
    ],
)
def test_what_the_grid_cannot_hold(overrides, quoted):
    with pytest.raises(ConfigError, match=re.escape(quoted)):
        load_scene("sand", [FEW, *overrides])


@pytest.mark.parametrize(
    ("make", "override", "quoted"),
    [
        (Scene.particles, MANY, "1000000000 particles would take 223.5"),
        (Scene.full_order, MANY, "65 × 65 × 65 nodes would take 510.4"),
        (Scene.full_order, "scene.dx=0.0025", "a grid of 401 × 401 × 401 nodes would take 1.9"),
    ],
)
def test_what_memory_cannot_hold_is_refused_before_any_work(make, override, quoted, monkeypatch):
    scene = load_scene("sand", [FEW, "scene.dt=1e-4", override])
    monkeypatch.setattr("nsf.scenes.checks.host_memory", lambda: 2**30)
    monkeypatch.setattr(Cylinder, "sample", None)
    monkeypatch.setattr("nsf.mpm.device.warp_device", lambda name: SimpleNamespace(is_cuda=False))
    expected = f"{quoted} GiB of memory and 1.0 GiB are available; take fewer"
    with pytest.raises(ConfigError, match=re.escape(expected)):
        make(scene)


def test_memory_of_a_gpu(sand, monkeypatch):
    """Solver and a block of frames on the GPU, the rest on the host."""
    gpu = SimpleNamespace(is_cuda=True, alias="cuda:0", free_memory=10 * 2**20)
    monkeypatch.setattr("nsf.mpm.device.warp_device", lambda name: gpu)
    with pytest.raises(ConfigError, match=r"nodes, on cuda:0, would take 0\.1 GiB of memory"):
        check_memory(sand, "fp64", "cuda", FP32)
    gpu.free_memory = 2**30
    check_memory(sand, "fp64", "cuda", FP32)
    monkeypatch.setattr("nsf.scenes.checks.host_memory", lambda: 600 * 2**20)
    with pytest.raises(ConfigError, match=r"nodes would take 0\.6 GiB of memory and 0\.6 GiB"):
        check_memory(sand, "fp64", "cuda", FP32)


@pytest.mark.parametrize("precision", ["fp64", "fp32"])
def test_bytes_are_those_that_the_solver_takes(sand, precision):
    expected = bytes_on_device(300, sand.grid, sand.material, precision_of(precision))
    assert sand.full_order(precision=precision, device="cpu").nbytes == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize(("particles", "density"), [(0, 1.0), (10, 0.0), (10, float("nan"))])
def test_bad_body(particles, density):
    with pytest.raises(ConfigError, match=f"particles={particles}|density={density}"):
        Body(Box((0.0, 0.0, 0.0), (1.0, 1.0, 1.0)), particles=particles, density=density)


CUBE = Box((0.0, 0.0, 0.0), (0.5, 0.5, 0.5))


class TestCoarsened:
    def test_has_as_many_steps_as_fill_the_time(self):
        scene = replace(load_scene("sand"), steps=100)
        assert scene.coarsened(0.5, 0.5).steps == 200
        assert scene.coarsened(1.0 / 3.0, 1.0 / 3.0).steps == 300
        assert scene.coarsened(1.0, 4).steps == 25

    def test_refuses_a_step_that_does_not_divide_the_time(self):
        scene = replace(load_scene("sand"), steps=100)
        with pytest.raises(ConfigError, match=r"multiple=3 does not divide scene\.steps=100"):
            scene.coarsened(1.0, 3)


class TestParticlesPerCell:
    def test_counted_on_the_grid(self):
        body = Body(CUBE, density=1.0, particles_per_cell=8)
        assert body.counted(0.1).particles == 1000
        assert body.counted(0.05).particles == 8000
        assert body.counted(0.1).particles_per_cell is None

    def test_a_number_stays(self):
        body = Body(CUBE, density=1.0, particles=17)
        assert body.counted(0.1) is body

    def test_in_a_scene(self):
        keys = ["scene.bodies.column.particles=null", "+scene.bodies.column.particles_per_cell=8.5"]
        coarse, fine = (load_scene("sand", [*keys, f"scene.dx={dx}"]) for dx in (0.04, 0.02))
        volume = next(iter(coarse.bodies.values())).shape.volume
        assert (
            next(iter(coarse.bodies.values())).particles
            == len(coarse.particles())
            == round(8.5 * volume / 0.04**3)
        )
        assert next(iter(fine.bodies.values())).particles == round(8.5 * volume / 0.02**3)

    @pytest.mark.parametrize("numbers", [{}, {"particles": 10, "particles_per_cell": 8}])
    def test_exactly_one(self, numbers):
        with pytest.raises(ConfigError, match="give exactly one"):
            Body(CUBE, density=1.0, **numbers)

    @pytest.mark.parametrize("value", [0.0, -8.0, float("nan"), float("inf")])
    def test_refused(self, value):
        with pytest.raises(ConfigError, match=f"particles_per_cell={value}"):
            Body(CUBE, density=1.0, particles_per_cell=value)

    def test_more_than_can_be_numbered(self):
        with pytest.raises(ConfigError, match=r"particles_per_cell=1e\+308 gives inf particles"):
            Body(CUBE, density=1.0, particles_per_cell=1e308).counted(0.01)

    def test_a_body_too_small_for_the_grid(self):
        with pytest.raises(ConfigError, match="gives no particle"):
            Body(CUBE, density=1.0, particles_per_cell=8).counted(100.0)


def test_several_bodies():
    """In order, each with its own density, velocity and weakness."""
    box = "{_target_: nsf.scenes.Box, lower: [0.1,0.1,0.2], upper: [0.2,0.3,0.4]}"
    weak = f"{{_target_: nsf.scenes.Weakness, share: 1.0, factor: 0.5, region: {box}}}"
    wall = f"{{_target_: nsf.scenes.Body, shape: {box}, particles: 50, density: 300, velocity: [0,1,0], weakness: {weak}}}"  # fmt: skip # noqa: E501
    scene = load_scene("sand", [FEW, f"+scene.bodies.wall={wall}"])
    constants, v = scene.particles(), scene.initial_velocity()
    column, other = slice(0, 300), slice(300, 350)
    assert len(constants) == len(v) == 350
    assert next(iter(scene.bodies.values())).shape.contains(constants.X[column]).all()
    assert list(scene.bodies.values())[1].shape.contains(constants.X[other]).all()
    np.testing.assert_allclose(constants.mass[other] / constants.volume0[other], 300.0)
    np.testing.assert_allclose(constants.mass[column] / constants.volume0[column], 200.0)
    assert constants.volume0[other].sum() == pytest.approx(0.1 * 0.2 * 0.2)
    assert (v[column] == 0.0).all()
    assert (v[other] == [0.0, 1.0, 0.0]).all()
    np.testing.assert_array_equal(constants.mu[other], 0.5 * scene.material.mu)
    np.testing.assert_array_equal(constants.lam[column], scene.material.lam)
    solver = scene.full_order(device="cpu")
    solver.step(3)
    moved = solver.state.numpy()["x"] - constants.X
    assert (moved[other, 1] > 0.0).all()
    assert np.abs(moved[column, 1]).max() < 0.01 * moved[other, 1].min()


# -- changes: another scene for the same manifold ---------------------------------------------------------


def test_changes_keep_the_particles():
    bread = load_scene("bread")
    changed = bread.changed({"bodies.slice.weakness.perturbation": 0.3, "scene.gravity": [0, 0, -1]})
    before, after = bread.particles(), changed.particles()
    np.testing.assert_array_equal(after.X, before.X)
    assert (after.mu < before.mu).any()
    assert (after.mu < before.mu.max()).sum() == (before.mu < before.mu.max()).sum()
    assert changed.gravity == (0.0, 0.0, -1.0)
    assert bread.gravity == (0.0, 0.0, 0.0)


def test_a_key_that_refers_to_a_changed_one_follows():
    sand = configuration.load(["scene=sand", FEW, "scene.bodies.column.density='${material.E}'"])
    changed = changed_scene(sand, scene_of(sand), {"material.E": 300.0})
    assert changed.bodies["column"].density == 300.0


def test_a_value_that_is_not_there_is_refused(sand):
    with pytest.raises(ConfigError, match=r"scene sand has no 'bodies\.block\.density': there is no 'block'"):
        sand.changed({"bodies.block.density": 1.0})
    with pytest.raises(ConfigError, match=r"bodies\.column: density=-1\.0"):
        sand.changed({"bodies.column.density": -1.0})


@pytest.mark.parametrize(
    ("change", "quoted"),
    [
        ({"scene.gravty": [0, 0, -1]}, "unknown key 'scene.gravty'; did you mean scene.gravity"),
        ({"scene.walls": 1}, "several keys in 'scene.walls'; did you mean scene.walls.kind"),
        ({"material.friction_angle": 3}, "is a problem parameter; set scene.design.test"),
        ({"scene.bodies.column.particles": 200}, "scene.bodies.column.particles gives other particles"),
        ({"scene.bodies.column.shape.radius": 0.05}, "gives other particles than the manifold is trained on"),
        ({"scene.dx": 0.02}, "scene.dx gives other grid nodes"),
        ({"scene.dt": 0.001}, "set it for the whole chain, scene.dt=…"),
        ({"material.nu": 0.7}, "material.nu=0.7 must lie in"),
    ],
)
def test_changes_refused(sand, change, quoted):
    with pytest.raises(ConfigError, match=re.escape(quoted)):
        changed_scene(configuration.load(["scene=sand", FEW]), sand, change)
