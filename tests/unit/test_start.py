"""What is refused, and what is there already, is told before anything heavy is imported."""

import subprocess
import sys

import pytest

from nsf.cli import main

HEAVY = ("torch", "warp", "pytorch_lightning", "lightning_fabric", "matplotlib", "pandas", "scipy")
_PROGRAM = f"""
import sys
from nsf.cli import main
try:
    main(sys.argv[1:])
except SystemExit as end:
    code = end.code or 0
print("imported:", *(name for name in {HEAVY} if name in sys.modules))
sys.exit(code)
"""


@pytest.fixture
def started(tmp_path, monkeypatch):
    """(*words) → exit code, both outputs, and which heavy modules the command imported."""
    monkeypatch.setenv("NSF_REPORTS", str(tmp_path / "reports"))

    def start(*words, runs=tmp_path / "runs"):
        monkeypatch.setenv("NSF_RUNS", str(runs))
        done = subprocess.run([sys.executable, "-c", _PROGRAM, *words], capture_output=True, text=True)
        *told, last = done.stdout.splitlines()
        return done.returncode, "\n".join(told), done.stderr, last.removeprefix("imported:").split()

    return start


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["run", "scene=sannd"], "did you mean sand"),
        (["run", "scene=sand", "latent_dim=0"], "latent_dim=0 must be"),
        (["train", "scene=sand", "latent_dmi=4"], "unknown key 'latent_dmi'"),
        (["run", "scene=sand", "model=recurence"], "did you mean recurrence"),
        (["run", "scene=sand", "model=recurrence", "model.teaching.width=0"], "width=0 must be at least 1"),
        (["run", "+experiment=tabel1"], "did you mean table1"),
        (["run", "-m", "scene=sand", "latent_dim=4,0"], "latent_dim=0 must be"),
        (["run", "scene=sand", "scene.bodies.column.density=0"], "density=0"),
        (["run", "scene=sand", "scene.design.train=[30]"], "1 training cases"),
        (["run", "scene=drop", "scene.geometry.mesh=none.obj"], "none.obj"),
        (["run"], "choose one of block, bread"),
    ],
)
def test_a_refused_configuration_imports_nothing_heavy(started, words, told):
    code, _, err, heavy = started(*words)
    assert code == 2
    assert told in err
    assert len(err.splitlines()) == 1
    assert not heavy


def test_a_chain_whose_results_are_there_imports_nothing_that_computes(started, chain, tiny, monkeypatch):
    monkeypatch.setenv("NSF_RUNS", str(chain.root))
    monkeypatch.setattr("nsf.results.report.draw", lambda *_: [])
    monkeypatch.setattr("nsf.results.pictures.sections", lambda *_: [])
    with pytest.raises(SystemExit) as ended:
        main(["report", *tiny])
    assert not ended.value.code
    code, out, _, heavy = started("run", *tiny, runs=chain.root)
    assert code == 0
    assert "evaluate: inputs unchanged, reused" in out
    assert "report: evaluated runs: 1, unchanged, reused" in out
    assert not {"torch", "warp", "pytorch_lightning", "matplotlib"} & {*heavy}


@pytest.mark.slow
def test_no_missing_driver_is_told_of_where_nothing_asks_for_it(started, chain, tiny):
    _, _, err, heavy = started("simulate", *tiny, "scene.steps=2", "deploy.split=train")
    assert "warp" in heavy
    assert "driver" not in err
