"""Evaluate runs and one report, made once for these tests."""

from contextlib import contextmanager

import pytest
from synthetic import Made, write_run

from nsf.reporting import build, build_report, pictures

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
def report(sweep, made_once):
    """The folder of a report of the sweep."""
    return made_once("reports", lambda root: build_report(sweep, root / "sand", "Sand & friends")) / "sand"


@pytest.fixture
def no_pictures(monkeypatch):
    """Drawing takes seconds, and some tests are about the rest."""
    monkeypatch.setattr(build, "draw", lambda merged, folder, **_: [])


@pytest.fixture(scope="module")
def few_pictures():
    """A context in which a variant has the two pictures that it has on a page of many."""

    @contextmanager
    def few():
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(pictures, "MANY", 0)
            yield

    return few
