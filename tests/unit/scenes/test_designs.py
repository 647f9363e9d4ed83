"""Designs of experiments, and the parameters that they draw."""

import math
import re
from dataclasses import replace

import numpy as np
import pytest

from nsf import load_scene
from nsf.data import Case
from nsf.errors import ConfigError
from nsf.scenes import Grid, LatinHypercube, Parameter, Sobol, Values
from nsf.scenes.designs import evenly, random_cases

RANGES = {
    "E": Parameter("material.E", "Pa", [800, 3000], log=True),
    "nu": Parameter("material.nu", "-", [0.1, 0.4]),
}
FREE = {"E": Parameter("material.E", "Pa"), "nu": Parameter("material.nu", "-")}
TWO = (
    "+scene.parameters.E.range=[800,3000]",
    "+scene.parameters.nu={key:material.nu,unit:'-',range:[0.1,0.4]}",
)


def numbers(cases):
    return np.array([case.numbers for case in cases])


@pytest.mark.parametrize("kind", [Sobol, LatinHypercube])
def test_drawn_cases_lie_in_the_ranges_and_no_two_are_one(kind):
    split = kind(train=16, validation=5, test=3).split(RANGES)
    assert tuple(map(len, (split.train, split.validation, split.test))) == (16, 5, 3)
    values = numbers(split.cases)
    assert (values >= [800, 0.1]).all()
    assert (values <= [3000, 0.4]).all()
    assert len(np.unique(values, axis=0)) == 24
    assert split == kind(16, 3, 5).split(RANGES)
    assert split != kind(16, 3, 5, seed=1).split(RANGES)


@pytest.mark.parametrize("kind", [Sobol, LatinHypercube])
def test_a_sixteenth_of_each_range_has_one_of_sixteen_cases_even_in_log(kind):
    values = numbers(kind(train=16, test=1).split(RANGES).train)
    values[:, 0] = np.log(values[:, 0])
    low, high = np.array([math.log(800), 0.1]), np.array([math.log(3000), 0.4])
    pieces = np.floor(16 * (values - low) / (high - low))
    assert all(sorted(column) == list(range(16)) for column in pieces.T)


def test_more_sobol_cases_keep_those_of_fewer():
    few, many = Sobol(6, 3, 2).split(RANGES), Sobol(16, 5, 2).split(RANGES)
    assert many.train[:6] == few.train
    assert many.test[:3] == few.test
    assert many.validation == few.validation


@pytest.mark.parametrize("design", [Sobol(6, 3, 2), LatinHypercube(6, 3, 2), Grid((3, 2), 3, 2)])
def test_test_cases_may_be_others_beside_the_same_training(design):
    own, other = (replace(design, test_seed=seed).split(RANGES) for seed in (None, 7))
    assert (own.train, own.validation) == (other.train, other.validation)
    assert not {*own.test} & {*other.test}
    assert other.test == replace(design, seed=7).split(RANGES).test  # as are the numbers of programs
    with pytest.raises(ConfigError, match=re.escape("scene.design.test_seed=-1 must be a whole number")):
        replace(design, test_seed=-1)


def test_a_drawn_value_is_what_its_text_says():
    for case in Sobol(8, 1).split(RANGES).train:
        assert tuple(float(part.split("=")[1].split()[0]) for part in str(case).split(", ")) == case.numbers


def test_a_grid_reaches_the_ends_and_what_is_held_out_lies_between():
    split = Grid(train=[3, 2], test=4, validation=1).split(RANGES)
    assert np.allclose(
        numbers(split.train),
        [[E, nu] for E in (800, math.sqrt(800 * 3000), 3000) for nu in (0.1, 0.4)],
        rtol=1e-5,
    )
    assert len(split.test) == 4
    assert len(split.validation) == 1
    assert (numbers(split.test) > [800, 0.1]).all()
    assert (numbers(split.test) < [3000, 0.4]).all()


def test_values_of_one_parameter_are_numbers_and_of_several_lists_or_mappings():
    assert Values([1, 2.0], [3]).split({"E": FREE["E"]}).test == (Case(("E",), (3.0,)),)
    split = Values([[1, 2], {"nu": 4, "E": 3}], []).split(FREE)
    assert [case.numbers for case in split.train] == [(1.0, 2.0), (3.0, 4.0)]
    assert split.train[0].units == ("Pa", "-")


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Parameter("material.E", "Pa", [2, 2]), "nothing inside; give the smaller end first"),
        (lambda: Parameter("material.E", "Pa", [3, 2]), "nothing inside; give the smaller end first"),
        (lambda: Parameter("material.E", "Pa", [0, 2], log=True), "reaches zero; a logarithmic scale"),
        (lambda: Parameter("material.E", "Pa", [1, 2, 3]), "must be 2 finite numbers"),
        (lambda: Sobol(0, 1), "train=0 must be a whole number of at least 1"),
        (lambda: Sobol(4, 0), "test=0 must be a whole number of at least 1"),
        (lambda: LatinHypercube(4, 1, -1), "validation=-1 must be"),
        (lambda: Sobol(4, 1).split(FREE), "parameters.E has no range, which Sobol draws from; give it"),
        (lambda: Grid([2], 1).split(RANGES), r"train=\[2\] must be 2 numbers of values"),
        (lambda: Grid([2, 0], 1).split(RANGES), "train=0 must be"),
        (lambda: Values(3, [1]), r"train=3 must be a list, as \[3\]"),
        (lambda: Values([1], []).split(FREE), "train: 1 must have 2 finite numbers, as E, nu"),
        (lambda: Values([[1, math.nan]], []).split(FREE), "must have 2 finite numbers"),
        (lambda: Values([{"E": 1, "mu": 2}], []).split(FREE), "train has no parameter 'mu'; there are E, nu"),
        (lambda: Values([[900, 0.2]], [[700, 0.2]]).split(RANGES), "test: E=700 is outside of scene.param"),
        (lambda: Values([[900, 0.2]], [[900, 0.2]]).split(RANGES), "in both train and test"),
    ],
)
def test_a_bad_design_says_what_to_do(make, message):
    with pytest.raises(ConfigError, match=message):
        make()


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["scene.parameters.E=null"], r"parameters=\{'E': None\} leaves nothing to vary"),
        (["+scene.parameters.F={key:material.E,unit:Pa}"], "E and F are both material.E; leave one out"),
        (["+scene.parameters.x-y={key:material.nu,unit:''}"], "has the name 'x-y'; give up to 40 letters"),
        (["scene.parameters.E=3"], "scene.parameters.E=3 must map keys to values"),
        (["+scene.parameters.E.range=[3000,2000]"], r"parameters.E: range=\[3000, 2000\] has nothing inside"),
        (["~scene.design"], "scene.design=null must map keys to values"),
        (["scene.design._target_=nsf.scenes.Box"], "nsf.scenes.Box is no Design"),
        (["scene.parameters.E.key=scene.name"], "'scene.name' names no key that holds a number"),
    ],
)
def test_a_bad_scene_says_what_to_do(overrides, message):
    with pytest.raises(ConfigError, match=message):
        load_scene("drop", overrides)


def test_a_scene_of_two_parameters():
    scene = load_scene("drop", [*TWO, "scene.design={_target_:nsf.scenes.Sobol,train:8,validation:0,test:2}"])
    case = scene.split.test[0]
    at = scene.at(case)
    assert (at.material.E, at.material.nu) == case.numbers
    assert scene.case() == Case(("E", "nu"), (4000.0, 0.3))
    assert scene.case({"nu": 0.2}) == Case(("E", "nu"), (4000.0, 0.2))
    assert scene.case([1, 2]).named == "E=1 Pa, nu=2"
    assert scene.at({"nu": 0.2}).material.E == 4000.0
    with pytest.raises(ConfigError, match="drop has no parameter 'mu'; there are E, nu"):
        scene.at({"mu": 1.0})


def test_null_leaves_out_a_parameter_of_the_scene_below():
    (name,) = load_scene(
        "drop",
        ["scene.parameters.E=null", TWO[1], "scene.design.train=[0.2,0.3]", "scene.design.test=[0.25]"],
    ).parameters
    assert name == "nu"


def test_evenly_fills_a_cube_however_many_points_are_taken():
    assert np.allclose(evenly(3, 1)[:, 0], np.arange(1, 4) * 2 / (1 + math.sqrt(5)) % 1.0)
    assert evenly(4, 0).shape == (4, 0)
    for count in (16, 40):
        quarters = np.floor(2 * evenly(count, 2)) @ [1, 2]
        assert (np.bincount(quarters.astype(int), minlength=4) >= 0.75 * count / 4).all()


def test_random_cases_are_spread_and_none_is_taken():
    box, known = np.array([[20.0, 40.0]]), [Case(("friction_angle",), (20.0,))]
    cases = random_cases(box, 5, 0, known)
    assert cases == sorted(cases) == random_cases(box, 5, 0, known)
    fifths = [int((case["friction_angle"] - 20.0) // 4.0) for case in cases]
    assert fifths == list(range(5))  # shaken, each in its own
    assert random_cases(box, 5, 0, [*known, cases[2]]) == cases[:2] + cases[3:]
    assert random_cases(box, 5, 1, known) != cases


def test_random_cases_fill_a_box_of_two_parameters():
    known = Case(("E", "friction"), (0.0, 0.0))
    cases = random_cases(np.array([[0.0, 1.0], [-2.0, 2.0]]), 16, 0, [known])
    numbers = np.array([case.numbers for case in cases])
    halves = (numbers[:, 0] >= 0.5) + 2 * (numbers[:, 1] >= 0.0)
    assert numbers.shape == (16, 2)
    assert np.bincount(halves, minlength=4).min() >= 3
