"""The chains of the goldens, made once for all modules."""

import pytest
from chains import Chains


@pytest.fixture(scope="package")
def chains(tmp_path_factory):
    """Chains whose networks have the values of `inputs/`."""
    return Chains(tmp_path_factory.mktemp("golden") / "runs")
