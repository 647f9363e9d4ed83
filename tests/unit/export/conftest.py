"""Playbacks of the tiny chain, and what they hold by another way."""

import shutil

import pytest

from nsf.export.playback import Playback


@pytest.fixture(scope="package")
def deployed(chain):
    """The tiny chain's deploy run."""
    return chain.pipeline.deployment


@pytest.fixture(scope="package")
def played(deployed):
    """(points, **options) → the playback of the tiny chain, every fifth of its 24 steps."""

    def play(points=None, every=5, **options) -> Playback:
        return Playback(deployed, points=points, every=every, device="cpu", **options)

    return play


@pytest.fixture(scope="module")
def own_root(chain, tmp_path_factory):
    """A copy of the tiny chain's runs, to which a test may add others."""
    return shutil.copytree(chain.root, tmp_path_factory.mktemp("own") / "runs")
