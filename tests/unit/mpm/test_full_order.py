"""The full-order solver: time step limits, failure reports, repeatability, precision."""

import re

import numpy as np
import pytest

from nsf.errors import ConfigError, DeviceError, InstabilityError, ShapeError
from nsf.mpm import DomainWalls, HalfSpace, Transfer, diagnosed
from nsf.mpm.materials import DruckerPrager

DX = 1.0 / 16.0
ISOLATED = 7


@pytest.fixture
def with_isolated(block):
    """The block, with particle 7 alone in a corner: what happens to it reaches no other."""
    X = block.copy()
    X[ISOLATED] = (0.2, 0.2, 0.2)
    return X


def named_dt(error):
    return float(re.search(r"largest stable dt is (\S+) s", str(error)).group(1))


@pytest.mark.parametrize("E", [3.0, 4567.0])
@pytest.mark.parametrize("limit", ["elastic", "advective"])
def test_cfl_refusal_names_an_accepted_step(limit, E, block, solver_of):
    v = np.zeros_like(block)
    if limit == "advective":
        v[3] = [0.0, 37.0 * E**0.5, 0.0]
    with pytest.raises(InstabilityError, match="dt=1 s is unstable") as refusal:
        solver_of(block, dt=1.0, E=E, v=v)
    largest = named_dt(refusal.value)
    wave = np.sqrt(E * 0.7 / (1.3 * 0.4))  # λ + 2μ̂ = E(1 − ν)/((1 + ν)(1 − 2ν)), ρ = 1
    assert largest == pytest.approx(DX / (wave if limit == "elastic" else 37.0 * E**0.5), rel=1e-4)
    solver_of(block, dt=largest, E=E, v=v)
    with pytest.raises(InstabilityError):
        solver_of(block, dt=1.001 * largest, E=E, v=v)


@pytest.mark.parametrize("dt", [0.0, -0.001, float("nan"), float("inf")])
def test_dt_must_be_positive_and_finite(dt, block, solver_of):
    with pytest.raises(InstabilityError, match=re.escape(f"dt={dt} s must be positive")):
        solver_of(block, dt=dt)


@pytest.mark.parametrize("check_every", [1, 4])
@pytest.mark.parametrize("field", ["x", "v", "tau"])
def test_non_finite_particle_is_named(field, check_every, with_isolated, solver_of):
    solver = solver_of(with_isolated, check_every=check_every)
    solver.step(2)
    values = getattr(solver.state, field).numpy().copy()
    values[ISOLATED] = np.nan
    getattr(solver.state, field).assign(values)
    step = 3 if check_every == 1 else 4
    with pytest.raises(
        InstabilityError, match=rf"particle 7 became non-finite at step {step}, t = {0.002 * step:g} s"
    ):
        solver.step(10)
    assert solver.steps_taken == step


def test_particle_that_leaves_is_named(with_isolated, solver_of):
    with_isolated[ISOLATED] = (0.9, 0.2, 0.2)
    v = np.zeros_like(with_isolated)
    v[ISOLATED] = [5.0, 0.0, 0.0]
    solver = solver_of(with_isolated, v=v, check_every=1)
    with pytest.raises(
        InstabilityError, match=r"particle 7 left the grid at step (\d+), t = \S+ s: x = "
    ) as error:
        solver.step(100)
    step, time = re.search(r"at step (\d+), t = (\S+) s", str(error.value)).groups()
    assert int(step) == solver.steps_taken > 1
    assert float(time) == pytest.approx(0.002 * int(step))
    assert solver.state.x.numpy()[ISOLATED, 0] > 1.0 - 0.5 * DX


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("x", (0.01, 0.5, 0.5), "particle 7 left the grid at step 0"),
        ("v", (0.0, np.nan, 0.0), "particle 7 became non-finite at step 0"),
    ],
)
def test_bad_initial_state_is_named(field, value, message, block, solver_of):
    start = {"x": block.copy(), "v": np.zeros_like(block)}
    start[field][ISOLATED] = value
    with pytest.raises(InstabilityError, match=message):
        solver_of(block, **start)


def test_shapes_of_the_initial_state(block, solver_of):
    with pytest.raises(ShapeError, match=r"\(199, 3\)"):
        solver_of(block, v=np.zeros((199, 3)))
    with pytest.raises(ShapeError, match=r"\(200, 2\)"):
        solver_of(block, x=np.zeros((200, 2)))


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"check_every": 0}, ConfigError, "check_every=0"),
        ({"precision": "fp16"}, ConfigError, "precision=fp16"),
    ],
)
def test_bad_options(options, error, message, block, solver_of):
    with pytest.raises(error, match=message):
        solver_of(block, **options)


def test_unknown_device(block, constants_of):
    from nsf.mpm import FullOrderMPM, GridGeometry
    from nsf.mpm.materials import FixedCorotated

    grid = GridGeometry.of_domain((1.0, 1.0, 1.0), DX)
    with pytest.raises(DeviceError, match="device=tpu"):
        FullOrderMPM(constants_of(block), FixedCorotated(10.0, 0.3), grid, 0.002, device="tpu")


@pytest.fixture
def falling_sand(block, solver_of):
    """(precision, shape) → sand thrown at the floor."""

    def build(precision="fp64", shape="quadratic"):
        floor = HalfSpace((0.0, 0.0, 0.4), (0.0, 0.0, 1.0), "separate", 0.3)
        return solver_of(
            block,
            E=100.0,
            material=DruckerPrager(100.0, 0.3, 30.0),
            gravity=(0.0, 0.0, -10.0),
            colliders=[floor],
            walls=DomainWalls(),
            transfer=Transfer("apic", shape),
            v=np.tile([0.5, 0.0, -1.0], (len(block), 1)),
            precision=precision,
        )

    return build


@pytest.mark.parametrize("precision", ["fp64", "fp32"])
def test_two_runs_agree_to_the_last_bit(precision, falling_sand):
    first, second = falling_sand(precision), falling_sand(precision)
    first.step(40)
    for _ in range(40):
        second.step()
    for name, values in first.state.numpy().items():
        assert np.array_equal(values, second.state.numpy()[name]), name


@pytest.mark.parametrize("shape", ["quadratic", "cubic"])
def test_fp32_follows_fp64(shape, falling_sand):
    double, single = falling_sand("fp64", shape), falling_sand("fp32", shape)
    double.step(30)
    single.step(30)
    a, b = double.state.numpy(), single.state.numpy()
    assert b["x"].dtype == np.float32
    assert np.abs(a["x"] - b["x"]).max() < 1e-5
    assert np.abs(a["v"] - b["v"]).max() < 1e-3
    assert np.abs(a["tau"] - b["tau"]).max() < 1e-2 * np.abs(a["tau"]).max()


def test_state_copies_do_not_change_under_the_caller(falling_sand):
    solver = falling_sand()
    before = solver.state.numpy()
    x = before["x"].copy()
    solver.step(5)
    assert np.array_equal(before["x"], x)
    assert not np.array_equal(solver.state.numpy()["x"], x)


def test_time_and_bytes(falling_sand):
    solver = falling_sand()
    solver.step(3)
    assert solver.time == pytest.approx(0.006)
    # 17³ nodes of mass and momentum in 8-byte reals, a mark and an entry of a list for each of 5³ blocks.
    assert solver.grid.nbytes == 17**3 * 4 * 8 + (5**3 * 2 + 1) * 4
    assert solver.nbytes > solver.grid.nbytes + 200 * (3 + 3 + 3 * 9) * 8


# -- the elastic CFL number in motion -------------------------------------------------------------------


@pytest.mark.parametrize("precision", ["fp64", "fp32"])
def test_cfl_at_rest_is_the_checked_one(precision, block, solver_of):
    solver = solver_of(block, precision=precision)
    wave = np.sqrt(10.0 * 0.7 / (1.3 * 0.4))
    assert solver.elastic_cfl() == pytest.approx(wave * 0.002 / DX, rel=2e-3)


def test_cfl_grows_with_the_stretch(block, solver_of):
    """Fixed corotated: ρ₀ c² = 2μ̂ λ² + λ J² along a stretch λ."""
    solver = solver_of(block)
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    F = turn @ np.diag([3.0, 0.9, 0.6])
    solver.state.F_e.assign(np.tile(F, (len(block), 1, 1)))
    mu, lam = 10.0 / 2.6, 10.0 * 0.3 / (1.3 * 0.4)
    speed = np.sqrt(2.0 * mu * 9.0 + lam * (3.0 * 0.9 * 0.6) ** 2)
    assert solver.elastic_cfl() == pytest.approx(speed * 0.002 / DX, rel=2e-3)


def test_a_diagnosis_looks_at_the_check_before(block, solver_of):
    def build():
        v = 40.0 * (block - 0.5) * [1.0, 0.0, 0.0]
        return solver_of(block, dt=0.014, v=v, check_every=2)

    solver = build()
    solver.step(2)
    found = str(diagnosed(InstabilityError("lost; reduce dt"), build, 4))
    rest, motion = build().elastic_cfl(), solver.elastic_cfl()
    assert motion > 1.0 > rest
    assert f"lost; reduce dt; elastic CFL c dt/dx = {rest:.3g} at rest, {motion:.3g} at step 2" in found
    assert f"try dt={0.014 / motion:.2g} s" in found
    calm = str(diagnosed(InstabilityError("lost"), lambda: solver_of(block), 1))
    assert "at step 0 (limit 1)" in calm
    assert "try" not in calm
