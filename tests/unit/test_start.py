"""What is refused, and what is there already, is told before anything heavy is imported."""

import json
import subprocess
import sys

import pytest

from nsf.cli import main

HEAVY = ("warp", "torch", "pytorch_lightning", "lightning_fabric", "matplotlib", "pandas", "scipy")
#: Every command line of `sys.argv[1]` in turn: its exit code, both outputs, and what is imported by then.
_PROGRAM = f"""
import contextlib, io, json, sys
from nsf.cli import main
ended = []
for words in json.loads(sys.argv[1]):
    out, err, code = io.StringIO(), io.StringIO(), 0
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            main(words)
        except SystemExit as end:
            code = end.code or 0
    heavy = [name for name in {HEAVY} if name in sys.modules]
    ended.append((code, out.getvalue(), err.getvalue(), heavy))
print(json.dumps(ended))
"""


@pytest.fixture
def started(tmp_path, monkeypatch):
    """(command lines, runs) → exit code, both outputs and heavy modules of each, in one fresh process."""
    monkeypatch.setenv("NSF_REPORTS", str(tmp_path / "reports"))

    def start(commands, runs=tmp_path / "runs"):
        monkeypatch.setenv("NSF_RUNS", str(runs))
        words = [sys.executable, "-c", _PROGRAM, json.dumps(commands)]
        done = subprocess.run(words, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        return json.loads(done.stdout.splitlines()[-1])

    return start


REFUSED = [
    (["run", "scene=sannd"], "did you mean sand"),
    (["run", "scene=sand", "latent_dim=0"], "latent_dim=0 must be"),
    (["train", "scene=sand", "latent_dmi=4"], "unknown key 'latent_dmi'"),
    (["run", "scene=sand", "model=recurence"], "did you mean recurrence"),
    (["run", "+experiment=tabel1"], "did you mean table1"),
    (["run", "-m", "scene=sand", "latent_dim=4,0"], "latent_dim=0 must be"),
    (["run", "scene=sand", "scene.bodies.column.density=0"], "density=0"),
    (["plan", "scene=sand", "scene.dt=-1"], "scene.dt=-1 s must be positive"),
    (["plan", "scene=sand", "trainer.steps=many"], "trainer.steps=many must be a whole number or a list"),
    (["plan", "scene=sand", "scene.gravity=down"], "scene.gravity=down"),
    (["plan", "scene=sand", "material._target_=nsf.mpm.Transfer"], "nsf.mpm.Transfer"),
    (["run", "scene=sand", "scene.design.train=[30]"], "1 training cases"),
    (["run", "scene=drop", "scene.geometry.mesh=none.obj"], "none.obj"),
    (["run"], "choose one of block, bread"),
]


def test_a_refused_configuration_imports_nothing_heavy(started):
    ended = started([words for words, _ in REFUSED])
    for (words, quoted), (code, _, err, heavy) in zip(REFUSED, ended, strict=True):
        assert (code, heavy) == (2, []), words
        assert quoted in err
        assert len(err.splitlines()) == 1, err


def test_a_chain_whose_results_are_there_imports_nothing_that_computes(started, chain, tiny, monkeypatch):
    monkeypatch.setenv("NSF_RUNS", str(chain.root))
    monkeypatch.setattr("nsf.results.report.draw", lambda *_: [])
    monkeypatch.setattr("nsf.results.pictures.sections", lambda *_: [])
    with pytest.raises(SystemExit) as ended:
        main(["report", *tiny])
    assert not ended.value.code
    ((code, out, _, heavy),) = started([["run", *tiny]], chain.root)
    assert code == 0
    assert "evaluate: inputs unchanged, reused" in out
    assert "report: evaluated runs: 1, unchanged, reused" in out
    assert not {"torch", "pytorch_lightning", "matplotlib"} & {*heavy}


@pytest.mark.slow
def test_no_missing_driver_is_told_of_where_nothing_asks_for_it(started, chain, tiny):
    ((_, _, err, _),) = started([["simulate", *tiny, "scene.steps=2", "deploy.split=train"]])
    assert "driver" not in err
