"""Words of `nsf calibrate`, `nsf sample` and `nsf design` that are refused before a model is loaded."""

import pytest

from nsf.errors import NSFError
from nsf.inverse.model import Model
from nsf.inverse.reports.command import calibrate, design, sample

SEEN, TARGET = "observations={rows}", "x@0.5:0.5:0.2=0.5"
FIRST = "t,particle,x,deviation\n0.1,5,0.5,0.001\n"


@pytest.mark.parametrize(
    ("command", "words", "rows", "quoted"),
    [
        (calibrate, ["observations=none.csv"], FIRST, "none.csv is no file"),
        (calibrate, [SEEN, "frction_angle=30"], FIRST, "no key 'frction_angle'"),
        (calibrate, [SEEN, "friction_angle=90"], FIRST, "friction_angle=90 goes beyond what was taught"),
        (calibrate, [SEEN, "run=nosuch"], FIRST, "begins with, 'nosuch'"),
        (calibrate, [SEEN, "program=1"], FIRST, "has no programs"),
        (calibrate, [SEEN, "trials=-1"], FIRST, "trials=-1 must be a whole number"),
        (calibrate, [SEEN], FIRST.replace("0.1,", "99,"), "row 1: t=99 is outside of the run, 0 …"),
        (calibrate, [SEEN], FIRST.replace("0.1,", "0.121,"), "row 1: t=0.121 is outside of the run, 0 …"),
        (calibrate, [SEEN], "t,X,Y,Z,x,deviation\n0.1,3,0,0,3,0.1\n", "X=3 is outside of the body at rest"),
        (sample, ["runs=-5"], FIRST, "runs=-5 must be a whole number"),
        (sample, ["of=hight"], FIRST, "of=hight is none of height"),
        (sample, ["observations=none.csv"], FIRST, "none.csv is no file"),
        (design, ["tilt=10"], FIRST, "takes target=FILE, or scalars"),
        (design, [TARGET, "tilt=-10"], FIRST, "tilt=-10 must be positive"),
        (design, [TARGET, "tilt=1", "knots=0"], FIRST, "knots=0 must be a whole number"),
        (design, [TARGET, "tilt=1", "friction_angle=25..30"], FIRST, "must be one value"),
        (design, ["target=none.csv", "tilt=1"], FIRST, "none.csv is no file"),
    ],
)
def test_a_refusal_loads_no_model(deployed, tmp_path, monkeypatch, command, words, rows, quoted):
    (tmp_path / "rows.csv").write_text(rows)
    run = [] if "run=nosuch" in words else [f"run={deployed.deployment.path}"]
    monkeypatch.setenv("NSF_RUNS", str(deployed.root))
    monkeypatch.setattr(Model, "__init__", lambda *_: pytest.fail("a model was loaded"))
    with pytest.raises(NSFError) as error:
        command([*run, *(word.format(rows=tmp_path / "rows.csv") for word in words)])
    assert quoted in str(error.value)
