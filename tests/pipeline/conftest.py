"""Copies of the tiny chain, and the command line in a process of its own."""

import shutil

import pytest
from forked import run_nsf


@pytest.fixture
def copied(chain, tmp_path):
    """(*stages) → a folder of runs that holds these stages of the tiny chain."""

    def copy(*stages):
        root = tmp_path / "runs"
        for stage in stages:
            shutil.copytree(chain.root / stage, root / stage)
        root.mkdir(exist_ok=True)
        return root

    return copy


@pytest.fixture
def nsf(tmp_path, tiny):
    """(stage, root, *overrides, faults=()) → the outcome of the command line on the tiny scene."""

    def call(stage, root, *overrides, faults=(), multirun=False):
        keys = {o.split("=")[0].lstrip("~+") for o in overrides}
        base = [t for t in tiny if t.split("=")[0] not in keys]
        arguments = [stage, *(["-m"] if multirun else []), *base, *overrides]
        return run_nsf(arguments, root, tmp_path / "work", *faults)

    return call
