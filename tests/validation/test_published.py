"""Problems with published answers (physics.md, section 4), as `nsf validate` runs them."""

from importlib import import_module

import pandas as pd
import pytest

import nsf
from nsf.results.folder import read
from nsf.validation import validate
from nsf.validation.problem import Answer

SLOW = pytest.mark.slow
#: Keys of the scene and, by quantity, how far off [%] it may be; the committed report has the full sizes.
CASES = [
    pytest.param("incline", [], {"way in 0.3 s": 1.0}, id="incline"),
    pytest.param(
        "discs",
        ["scene.dx=0.04", "scene.dt=0.02", "scene.steps=210"],
        {"kinetic energy before": 0.1, "momentum over a disc's": 1e-9, "rise of total energy": 0.1},
        id="discs",
        marks=SLOW,
    ),
    pytest.param("settling", [], {"stress over ρ₀ g (l₀ − y₀), slope": 2.0}, id="settling", marks=SLOW),
    pytest.param("taylor_bar", [], {"final radius of the foot": 2.0}, id="taylor_bar", marks=SLOW),
    pytest.param(
        "cantilever",
        [],
        {f"w/L at P L²/EI = {ratio}": 2.0 for ratio in (1, 2, 5, 10)} | {"u/L at P L²/EI = 1": 1.0},
        id="cantilever",
        marks=SLOW,
    ),
]


@pytest.mark.parametrize(("name", "keys", "bounds"), CASES)
def test_answer_is_the_published_one(name, keys, bounds):
    scene = nsf.load_scene(name, keys)
    answers = {a.quantity: a for a in import_module(f"nsf.validation.{name}").answers(scene, "cpu")}
    for quantity, bound in bounds.items():
        assert abs(answers[quantity].difference) < bound, answers[quantity]


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
        monkeypatch.setattr(problem, "answers", lambda scene, device, answer=answer: iter([answer]))
        validate(tmp_path / "validation", {"problems": name}, said.append)
    rows = pd.read_csv(tmp_path / "validation/validation.csv")
    assert list(rows["problem"]) == ["settling", "incline"]
    assert list(rows["off"].round(9)) == [2.0, 2.0]
    content = read(tmp_path / "validation/sources.json")
    assert set(content["files"]) == {"index.html", "index.md", "off.png", "validation.csv"}
    assert "Block on an incline" in (tmp_path / "validation/index.md").read_text()
    assert len(said) == 3
