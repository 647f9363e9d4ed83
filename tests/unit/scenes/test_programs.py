"""Programs of the forcing against what they promise."""

import numpy as np
import pytest

import nsf
import nsf.scenes
from nsf.errors import ConfigError
from nsf.mpm import Gravity
from nsf.scenes import GravityCurve, Keyframes, Programs, RandomPress, RandomPush, RandomShake, RandomTilt

DOWN = (0.0, 0.0, -9.81)
T = np.linspace(0.0, 1.2, 400)
PUSH = "_target_: nsf.scenes.RandomPush, direction: [0,0,1]"
SMALL = ["scale=small", "scene.bodies.block.particles=200"]


def gravity_of(program, seed, base=DOWN):
    return program.of(Gravity.constant(base), 1.2, np.random.default_rng(seed)).at(T)


@pytest.mark.parametrize("base", [DOWN, (1.0, -2.0, 0.5)])
@pytest.mark.parametrize("seed", range(3))
def test_a_tilt_starts_upright_keeps_its_size_and_stays_in_reach(seed, base):
    program, size = RandomTilt(angle=35.0), np.linalg.norm(base)
    found = gravity_of(program, seed, base)
    np.testing.assert_allclose(found[0], base, atol=1e-12)
    angle = np.degrees(np.arccos(np.clip(found @ np.array(base) / size**2, -1.0, 1.0)))
    assert 3.0 < angle.max() < 35.0 + 1e-6
    # Between keyframes it is a chord of the sphere: shorter by a few thousandths.
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), size, rtol=5e-3)
    assert np.linalg.norm(found - base, axis=1).max() <= program.reach(np.array(base), 1.2) * (1 + 1e-9)


@pytest.mark.parametrize("seed", range(4))
def test_a_shake_adds_nothing_along_gravity(seed):
    program = RandomShake(acceleration=2.0)
    added = gravity_of(program, seed) - DOWN
    np.testing.assert_allclose(added[:, 2], 0.0, atol=1e-12)
    assert 0.3 < np.linalg.norm(added, axis=1).max() <= 2.0 * (1 + 1e-9)


def test_programs_of_other_seeds_differ_and_of_one_seed_do_not():
    one, same, other = (gravity_of(RandomTilt(35.0), seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(one, same)
    assert np.abs(one - other).max() > 0.5


@pytest.mark.parametrize(
    "program",
    [
        RandomPress((0.0, 0.0, 1.0), depth=(0.02, 0.06), stroke=(0.2, 0.5), hold=0.05, aside=0.01),
        RandomPress((0.0, 0.0, 1.0), depth=(0.02, 0.06), stroke=(0.2, 0.5)),
        RandomPush((0.0, 1.0, 0.0), reach=(-0.01, 0.05)),
    ],
)
@pytest.mark.parametrize("seed", range(4))
def test_a_solid_is_no_faster_and_goes_no_further_than_declared(program, seed):
    motion = program.motion(1.2, np.random.default_rng(seed))
    _times, shifts, _ = motion.keyframes()
    assert motion.top_speed(0.0) <= program.top_speed(1.2) * (1 + 1e-9)
    along = shifts @ np.array(program.direction)
    if isinstance(program, RandomPress):
        assert 0.02 <= along.max() <= 0.06
        assert abs(along[-1]) < 1e-12
        assert np.ptp(shifts[:, 0]) < 1e-12
        assert abs(shifts[0, 0]) <= 0.01
    else:
        assert along.min() >= -0.01 - 1e-12
        assert along.max() <= 0.05 + 1e-12


class Numbers(RandomTilt):
    """Gives the values of gravity instead of its keyframes."""

    def of(self, gravity, duration, generator):
        return gravity.at([0.0])


class Swing(GravityCurve):
    """Turns gravity about y, by an angle and a number of cycles that are drawn."""

    def values(self, t, gravity, draw):
        angle = np.radians(draw(5.0, 20.0)) * np.sin(2.0 * np.pi * draw(1.0, 3.0) * t / t[-1])
        gravity[:, 0], gravity[:, 2] = -gravity[:, 2] * np.sin(angle), gravity[:, 2] * np.cos(angle)
        return gravity


def test_a_curve_reaches_as_far_as_it_is_drawn_to():
    reach, turned = Swing().reach(np.array(DOWN), 1.2), 2.0 * 9.81 * np.sin(np.radians(10.0))
    assert turned <= reach <= 1.06 * turned
    assert Growing().reach(np.array(DOWN), 1.2) >= 2.0 * 9.81 * np.sin(0.4)
    drawn = [gravity_of(Swing(), seed) - DOWN for seed in range(200)]
    assert 0.95 * turned < np.linalg.norm(drawn, axis=2).max() <= reach
    assert Programs({"shake": RandomShake(2.0), "swing": Swing()}).reach(DOWN, 1.2) > reach + 2.0


class Growing(GravityCurve):
    """Swings further and further: it goes furthest where one number is at its end, and another is not."""

    def values(self, t, gravity, draw):
        angle = draw(0.3, 0.8) * t / t[-1] * np.sin(2.0 * np.pi * (1.5 * t / t[-1] + draw(0.0, 1.0)))
        return 9.81 * np.stack([np.sin(angle), 0.0 * t, -np.cos(angle)], axis=1)


class Scalar(GravityCurve):
    """Gives no vectors."""

    def values(self, t, gravity, draw):
        return t


class Failing(GravityCurve):
    """Reads a name that is not there."""

    def values(self, t, gravity, draw):
        return draw.low


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: gravity_of(Scalar(), 0), "along x, y and z"),
        (lambda: gravity_of(Failing(), 0), "Failing.values raises AttributeError"),
        (lambda: Programs({"own": Numbers(35.0)}).gravity_of(DOWN, 1.0, 0), "return a nsf.mpm.Gravity"),
        (lambda: RandomTilt(0.0), "angle=0° must lie between 0° and 180°"),
        (lambda: RandomTilt(35.0, knots=0), "knots=0 must be a whole number"),
        (lambda: RandomShake(float("nan")), "acceleration=nan must be a finite number"),
        (lambda: RandomPress((0, 0, 1), (0.2, 0.1), (0.1, 0.2)), "must be positive, the smaller one first"),
        (lambda: RandomPush((0, 0, 1), (0.1, 0.2)), "must go back and forth from 0"),
        (lambda: Keyframes((0.0, 1.0), (DOWN,)), "has 1 keyframes; give 2"),
        (lambda: gravity_of(Keyframes((0.0,), ((1, 0, 0),), angle=30.0), 0), "90° off, beyond angle=30°"),
    ],
)
def test_what_is_refused_says_why(make, message):
    with pytest.raises(ConfigError, match=message):
        make()


# -- scenes ---------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def block():
    return nsf.load_scene("block", SMALL)


def test_each_case_has_a_program_of_its_own_and_no_part_shares_one(block):
    split = block.split
    programs = [case["program"] for case in split.cases]
    assert len(set(programs)) == len(programs)
    assert split.box.shape == (2, 2)
    assert list(split.train[0].parameters) == ["E", "density"]
    one, other = (block.at(case).acting_gravity.at(T) for case in split.test[:2])
    assert np.abs(one - other).max() > 0.5
    more = nsf.load_scene("block", [*SMALL, "scene.design.test=12"]).split
    assert more.train == split.train
    assert more.test[:8] == split.test
    seeded = nsf.load_scene("block", [*SMALL, "scene.design.seed=1"]).split
    assert not {case["program"] for case in seeded.cases} & set(programs)


def test_a_case_left_out_is_as_configured(block):
    assert block.case([3000.0, 100.0])["program"] == 0.0
    assert block.case({"E": 3000.0, "program": 7})["program"] == 7.0
    np.testing.assert_array_equal(
        block.at({"program": 7}).acting_gravity.at(T),
        nsf.load_scene("block", [*SMALL, "scene.program=7"]).acting_gravity.at(T),
    )


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ([f"+scene.forcing.colliders.blade={{{PUSH}, reach: [0,1]}}"],
         "moves a collider that does not exist; there are floor"),
        ([f"+scene.forcing.colliders.floor={{{PUSH}, reach: [0,5]}}"], "more than a cell"),
        (["scene.forcing.gravity.tilt.angle=-3"], "angle=-3° must lie between"),
        (["+scene.forcing.wind={}"], r"unknown key 'scene\.forcing\.wind'"),
        (["scene.program=-1"], "scene.program=-1 must be a whole number of at least 0"),
        (["scene.forcing.gravity.tilt._target_=nsf.scenes.Ball"], "nsf.scenes.Ball is no GravityProgram"),
    ],
)  # fmt: skip
def test_a_forcing_that_cannot_be_meant_is_refused(overrides, message):
    with pytest.raises(ConfigError, match=message):
        nsf.load_scene("block", [*SMALL, *overrides])
