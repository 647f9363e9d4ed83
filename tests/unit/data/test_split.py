"""Splits by parameter value."""

import math

import pytest

from nsf.data import Split
from nsf.errors import ConfigError


def test_of():
    split = Split(train=[20, 25.0, 30.0], validation=(22.5,), test=(27.5,))
    assert split.train == (20.0, 25.0, 30.0)
    assert [split.of(value) for value in (20, 25.0, 22.5, 27.5)] == ["train", "train", "validation", "test"]
    assert split.of({"friction_angle": 27.5}) == "test"
    assert split.of([27.5]) == "test"
    assert hash(split) == hash(Split((20.0, 25.0, 30.0), (22.5,), (27.5,)))


def test_a_float32_round_trip_is_the_same_value():
    assert Split(train=(0.1,), test=(0.3,)).of(0.30000001192092896) == "test"
    with pytest.raises(ConfigError):
        Split(train=(0.1,), test=(0.3,)).of(0.3001)


def test_several_parameters_in_the_order_of_their_names():
    split = Split(train=((1.0, 20.0), (2.0, 20.0)), test=((1.0, 30.0),))
    assert split.of((2.0, 20.0)) == "train"
    assert split.of({"velocity": 30.0, "angle": 1.0}) == "test"
    with pytest.raises(ConfigError, match=r"\(30\.0, 1\.0\) is in no part"):
        split.of((30.0, 1.0))


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ({"train": (20, 25), "test": (25.0000001,)}, r"25\.0 is in both train and test; keep"),
        ({"train": (20,), "validation": (25,), "test": (25,)}, "25.0 is in both validation and test"),
        ({"train": (20, 20.0)}, r"20\.0 is twice in train"),
        ({"train": ()}, r"train=\(\) has no parameter value"),
        ({"train": (20,), "test": (math.nan,)}, "test holds nan; give finite"),
        ({"train": (math.inf,)}, "train holds inf"),
        ({"train": (20, (1, 2))}, r"\(1\.0, 2\.0\) beside 20\.0"),
        ({"train": ("warm",)}, "'warm' is no number"),
        ({"train": ((),)}, "give finite"),
    ],
)
def test_bad_splits(parts, message):
    with pytest.raises(ConfigError, match=message):
        Split(**parts)


def test_an_unknown_value_is_told_what_there_is():
    with pytest.raises(ConfigError, match=r"21\.0 is in no part.*train=\(20\.0,\).*test=\(25\.0,\).*add it"):
        Split(train=(20,), test=(25,)).of(21)
