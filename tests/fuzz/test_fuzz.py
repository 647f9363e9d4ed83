"""A short part of `make fuzz`, and the watch itself: it has to see what it is there to see."""

import os
import subprocess

import cases
import pytest
import watch
from fuzz import VIOLATIONS, drawn

from nsf.errors import ConfigError

CASES = 4  # of each kind
SLOW = {"evaluations": 1, "intermediates": 1}  # of kinds that draw charts or train
SEED = 2023  # not that of `make fuzz`


@pytest.fixture(scope="module")
def shop(chain, tiny, tmp_path_factory):
    before = {name: os.environ.get(name) for name in ("NSF_RUNS", "NSF_REPORTS")}
    folder = tmp_path_factory.mktemp("fuzz")
    with pytest.MonkeyPatch.context() as patch:
        cases.draw_coarsely(patch.setattr)
        yield cases.Workshop(folder, chain.root, tiny)
    for name, value in before.items():
        os.environ.pop(name) if value is None else os.environ.update({name: value})


@pytest.mark.parametrize("kind", cases.KINDS)
def test_malformed_input_is_refused_or_does_no_harm(shop, kind):
    endings = [(number, *drawn(shop, kind, number, SEED)) for number in range(SLOW.get(kind, CASES))]
    faults = [ending for ending in endings if ending[1] in VIOLATIONS]
    assert not faults, f"python tests/fuzz/fuzz.py --seed {SEED} --only {kind}:{faults[0][0]}\n{faults[0]}"


def test_the_watch_sees_what_a_case_does(tmp_path):
    def refused():
        raise ConfigError("no")

    def failed():
        raise KeyError("x")

    def swallowed():
        try:
            subprocess.run(["true"], check=True)
        except OSError as error:
            raise ConfigError("no") from error

    def stuck():
        while True:
            pass

    def wrote():
        (tmp_path / "elsewhere").write_text("x")

    inside = tmp_path / "work"
    inside.mkdir()
    seen = {
        run.__name__: watch.outcome(run, altered=False, folder=inside, limit=0.2)[0]
        for run in (refused, failed, swallowed, stuck, wrote)
    }
    assert seen == {
        "refused": "refused",
        "failed": "traceback",
        "swallowed": "code",
        "stuck": "hang",
        "wrote": "code",
    }
    assert watch.outcome(lambda: None, altered=True, folder=inside)[0] == "altered"
