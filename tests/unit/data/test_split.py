"""Cases, and splits by case."""

import math
import pickle

import numpy as np
import pytest

from nsf.data import Case, Split
from nsf.errors import ConfigError


def one(value):
    return Case(("friction_angle",), (value,), ("°",))


def two(E, friction):
    return Case(("E", "friction"), (E, friction), ("Pa", "-"))


def test_a_case_is_a_mapping_that_can_be_a_key():
    case = two(1500, 0.3)
    assert dict(case) == {"E": 1500.0, "friction": 0.3}
    assert case["friction"] == 0.3
    assert case == Case.of({"E": 1500.0, "friction": 0.3}) == pickle.loads(pickle.dumps(case))
    assert {case: 1}[two(1500.0, 0.3)] == 1
    assert sorted([two(2, 1), two(1, 2), two(1, 1)]) == [two(1, 1), two(1, 2), two(2, 1)]
    with pytest.raises(KeyError):
        case["mu"]


def test_texts_of_a_case():
    assert (str(one(26)), one(26).named, one(26).label) == ("26°", "friction_angle=26°", "friction_angle_26")
    assert str(two(1500, 0.3)) == two(1500, 0.3).named == "E=1500 Pa, friction=0.3"
    assert two(1500, 0.3).label == "E_1500_friction_0.3"
    assert one(26).column == 26.0
    assert two(1500, 0.3).column == "E=1500 Pa, friction=0.3"


@pytest.mark.parametrize(
    "case", [one(-26.5), two(1.5e7, 3e-5), Case(("tilt", "v"), (5, 2), ("°", "m/s, up"))]
)
def test_a_case_is_read_from_its_text(case):
    read = Case.read(case.named)
    assert read == case
    assert read.units == tuple(unit.strip("-") for unit in case.units)


@pytest.mark.parametrize("text", ["", "26", "E=", "E=warm", "E=1500Pa", "E=1, 2=3", "E=1e999", "<E>=1"])
def test_text_that_is_no_case_is_refused(text):
    with pytest.raises(ConfigError):
        Case.read(text)


@pytest.mark.parametrize("numbers", [(math.nan,), ("warm",), (1.0, 2.0), ()])
def test_a_case_has_a_finite_number_for_each_name(numbers):
    with pytest.raises(ConfigError):
        Case(("E",), numbers)


def test_a_split_knows_its_cases_and_the_box_of_training():
    split = Split([two(1, 0.2), two(3, 0.1)], test=[two(2, 0.3)])
    assert split.cases == (two(1, 0.2), two(3, 0.1), two(2, 0.3))
    assert split.names == ("E", "friction")
    assert np.array_equal(split.box, [[1.0, 3.0], [0.1, 0.2]])
    assert hash(split) == hash(Split((two(1, 0.2), two(3, 0.1)), (), (two(2, 0.3),)))


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ({"train": [one(20), one(25)], "test": [one(25)]}, "25° is in both train and test; a case"),
        ({"train": [one(20)], "validation": [one(25)], "test": [one(25)]}, "in both validation and test"),
        ({"train": [one(20), one(20.0)]}, "20° is twice in train"),
        ({"train": []}, r"train=\[\] must name at least one case"),
        ({"train": [one(20), two(1, 2)]}, r"train holds E=1 Pa, friction=2 beside friction_angle=20°"),
        ({"train": [two(1, 2), two(1, 2)]}, "E=1 Pa, friction=2 is twice in train"),
    ],
)
def test_bad_splits(parts, message):
    with pytest.raises(ConfigError, match=message):
        Split(**parts)
