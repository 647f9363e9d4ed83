"""The values that evaluation writes of three small experiments: errors and rivals, no times."""

import pytest
from chains import close, read, results
from configurations import EXPERIMENTS


@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_errors_are_the_same(chains, experiment):
    close(results(chains, experiment), read("results")[experiment], 1e-10, experiment)
