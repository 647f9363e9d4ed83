"""A linear system and a recurrent network, fitted to oscillators under a gravity that wanders."""

import math
import re

import numpy as np
import pytest
import torch

from nsf.errors import ConfigError, InstabilityError
from nsf.models.dmdc import DMDc
from nsf.models.gru import GRU
from nsf.models.inputs import Inputs, Lessons, Validation


class Fields:
    """A manifold as far as a fit sees it."""

    X = torch.zeros(3, 3)


def oscillators(count=24, steps=60, seed=0):
    """x̂ of two oscillators each, along gravity that wanders; the second begins with a push."""
    generator = np.random.default_rng(seed)
    gravity = generator.standard_normal((count, 1, 3)) + 0.1 * generator.standard_normal(
        (count, steps, 3)
    ).cumsum(1)
    first = np.tile([0.0, 0.02], (count, 1))
    path, d = [np.zeros((count, 2))], first
    for n in range(steps):
        d = d - 0.05 * path[-1] - 0.05 * d + 0.01 * gravity[:, n, :2]
        path.append(path[-1] + d)
    xhat, none = np.stack(path, 1), np.zeros((count, steps, 0))
    inputs = Inputs(("E",), np.ones((count, 1)), xhat[:, 0], first, gravity, none, 0.01)
    return Lessons(inputs, xhat.astype(np.float32), none[:, :1])


def validation():
    """Other runs, and the error of latent vectors there as a share of how far they move."""
    of = oscillators(4, seed=1)

    def error(xhat):
        return float(np.linalg.norm(xhat - of.xhat) / np.linalg.norm(of.xhat - of.xhat[:, :1]))

    return Validation(of.inputs, error, np.ones(2))


@pytest.mark.parametrize("stride", [1, 2])
def test_a_linear_system_is_identified(stride):
    model, held_back = DMDc("dmdc", stride=stride), validation()
    fitted = model.fit(Fields(), oscillators(), held_back, 0)
    assert held_back.error(model.run(fitted, held_back.inputs)) < (1e-4, 0.02)[stride - 1]


def test_a_recurrent_network_follows():
    held_back = validation()
    long, short = (GRU("gru", stride=2, width=16, descents=n, batch=24) for n in (200, 5))
    fitted = long.fit(Fields(), oscillators(), held_back, 0)
    assert held_back.error(long.run(fitted, held_back.inputs)) < 0.4
    one, other = (short.fit(Fields(), oscillators(), held_back, 0) for _ in range(2))
    assert all(torch.equal(one["net"][name], other["net"][name]) for name in one["net"])


def test_a_fit_that_is_lost_is_refused():
    held_back = validation()
    lost = Validation(held_back.inputs, lambda xhat: np.nan, held_back.moves)
    with pytest.raises(InstabilityError, match=r"loses a validation run; raise model\.ridge"):
        DMDc("dmdc", stride=1).fit(Fields(), oscillators(), lost, 0)


@pytest.mark.parametrize(
    ("options", "quoted"),
    [
        ({"delays": 3}, "model.delays=3 must be a list of numbers"),
        ({"delays": [2.5]}, "model.delays=2.5 must be a whole number"),
        ({"ridge": [math.nan]}, "model.ridge=nan must be a finite number"),
    ],
)
def test_values_that_no_fit_can_use_are_refused(options, quoted):
    with pytest.raises(ConfigError, match=re.escape(quoted)):
        DMDc("dmdc", **options)
