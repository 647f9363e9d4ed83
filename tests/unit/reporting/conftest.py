"""Evaluate runs and one report, made once for these tests."""

import pytest
from synthetic import Made, write_run

from nsf.reporting import build_report

SWEEP = (
    Made(),
    Made(sample=50, noise=0.007),
    Made(method="deformation_only", noise=0.05, dirty=True),
)


@pytest.fixture(scope="session")
def sweep(tmp_path_factory):
    """Three complete runs: two sample sizes of nsf, and the baseline at a dirty tree."""
    root = tmp_path_factory.mktemp("runs")
    return [write_run(root, made) for made in SWEEP]


@pytest.fixture(scope="session")
def report(sweep, tmp_path_factory):
    """The folder of a report of the sweep."""
    return build_report(sweep, tmp_path_factory.mktemp("reports") / "sand", "Sand & friends").parent
