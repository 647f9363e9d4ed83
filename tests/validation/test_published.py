"""Problems with published answers (physics.md, section 4), as `nsf validate` runs them."""

import itertools
import math
from importlib import import_module

import numpy as np
import pandas as pd
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

import nsf
from nsf.results.folder import read
from nsf.validation import cantilever, incline, validate
from nsf.validation.collapse import run_out
from nsf.validation.problem import Answer

SLOW = {"marks": pytest.mark.slow}
#: By problem, how far off [%] a quantity may be.
CASES = [
    pytest.param("incline", {"way in 0.3 s": 1.0}, id="incline"),
    pytest.param(
        "discs",
        {"kinetic energy before": 0.1, "momentum over a disc's": 1e-9, "rise of total energy": 0.1},
        id="discs",
        **SLOW,
    ),
    pytest.param("settling", {"stress over ρ₀ g (l₀ − y₀), slope": 2.0}, id="settling", **SLOW),
    pytest.param("taylor_bar", {"final radius of the foot": 2.0}, id="taylor_bar", **SLOW),
    pytest.param(
        "cantilever",
        {f"{name}/L at P L²/EI = {ratio}": 2.0 for ratio in cantilever.ELASTICA for name in "wu"},
        id="cantilever",
        **SLOW,
    ),
]


@pytest.mark.parametrize(("name", "bounds"), CASES)
def test_answer_is_the_published_one(name, bounds):
    """The first answers of each problem, as far as its bounds name them."""
    answers = import_module(f"nsf.validation.{name}").answers(nsf.load_scene(name), None, "cpu")
    for answer in itertools.islice(answers, len(bounds)):
        assert abs(answer.difference) < bounds[answer.quantity], answer


@pytest.mark.parametrize(("ratio", "published"), cantilever.ELASTICA.items())
def test_published_deflections_solve_the_elastica(ratio, published):
    """θ'' = −(P L²/EI) cos θ, θ(0) = θ'(1) = 0, w' = sin θ, x' = cos θ; θ'(0) by shooting."""

    def slope(s, y):
        return [y[1], -ratio * np.cos(y[0]), np.sin(y[0]), np.cos(y[0])]

    def end(curvature):
        return solve_ivp(slope, (0.0, 1.0), [0.0, curvature, 0.0, 0.0], rtol=1e-9, atol=1e-10).y[:, -1]

    curvature = brentq(lambda curvature: end(curvature)[1], 0.0, np.sqrt(2.0 * ratio))
    _, _, w, x = end(curvature)
    assert (w, 1.0 - x) == pytest.approx(published, abs=6e-6)


def test_a_block_rests_where_friction_exceeds_the_slope():
    (way,) = incline.answers(nsf.load_scene("incline", ["scene.colliders.plane.friction=0.58"]), None, "cpu")
    assert abs(way.computed) < 1e-3


def test_taller_columns_run_out_farther():
    """And by less than in proportion to their height."""
    coarse = nsf.load_scene("collapse", ["scene.dx=0.025", "scene.dt=9e-4", "scene.steps=1000"])
    low, high = (run_out(coarse, a, "cpu")[1] for a in (1.0, 2.0))
    assert low < high < 2.0 * low


@pytest.mark.slow
def test_run_out_grows_with_the_root_of_the_aspect_ratio():
    """Of tall columns, with an exponent of 1/2 within 0.1 (Lube et al. 2004)."""
    low, tall = (run_out(nsf.load_scene("collapse"), a, "cpu")[1] for a in (6.0, 10.0))
    assert math.log(tall / low) / math.log(10.0 / 6.0) == pytest.approx(0.5, abs=0.1)


def test_a_value_within_the_published_spread_is_not_off():
    spread = (7.22, 7.12, 7.11)
    assert Answer("radius", "mm", spread, "", 7.15).difference == 0.0
    assert Answer("radius", "mm", spread, "", 7.3644).difference == pytest.approx(2.0)
    assert Answer("radius", "mm", spread, "", 7.0389).difference == pytest.approx(-1.0)
    assert Answer("momentum", "%", (0.0,), "", 0.3).difference == 0.3


def test_a_report_is_listed_and_keeps_the_rows_of_other_problems(tmp_path, monkeypatch):
    """Each problem in turn: rows of one that is run again take the place of the old ones."""
    said = []
    for name in ("incline", "settling", "incline"):
        problem = import_module(f"nsf.validation.{name}")
        answer = Answer("way", "m", (0.5,), "closed form", 0.51)
        monkeypatch.setattr(problem, "answers", lambda scene, finer, device, answer=answer: iter([answer]))
        validate(tmp_path / "validation", {"problems": f"{name},{name}"}, said.append)
    rows = pd.read_csv(tmp_path / "validation/validation.csv")
    assert list(rows["problem"]) == ["settling", "incline"]
    assert list(rows["off"].round(9)) == [2.0, 2.0]
    content = read(tmp_path / "validation/sources.json")
    assert set(content["files"]) == {"index.html", "index.md", "off.png", "validation.csv"}
    assert "Block on an incline" in (tmp_path / "validation/index.md").read_text()
    assert len(said) == 3
