"""The picture of who took the steps of a run."""

from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from matplotlib.colors import to_hex

from nsf.deployment.levels import LEVELS as BY
from nsf.reporting.drawing.levels import LEVELS, levels_over_time, name_of
from nsf.reporting.sections import levels
from nsf.reporting.sections.levels import lend_stages, levels_section


def series_of(*by: int, parameter: float = 0.6) -> pd.DataFrame:
    n = len(by)
    return pd.DataFrame(
        {"parameter": parameter, "t": 0.1 * np.arange(n + 1), "displacement_error": 0.01 * np.arange(n + 1),
         "by": [np.nan, *by]}
    )  # fmt: skip


def variant(label, *series, scene="jelly_cube", engine="levels", seeds=(), setting=""):
    rows = pd.concat(series)
    return SimpleNamespace(
        rows=pd.DataFrame({"engine": [engine], "setting": [setting]}),
        scene=scene, body=scene, label=label, parameter=("speed", "m/s"), runs=[f"evaluate/{label}"],
        series=lambda held_out_only: rows, seeds=set(seeds),
    )  # fmt: skip


@pytest.mark.parametrize(
    ("by", "name"),
    [
        ((0, 0), "operators alone"),
        ((1, 1), "projected step alone"),
        ((0, 1, 0), "operators and projected step"),
        ((0, 1, 2), "operators and projected step and full-order solver"),
    ],
)
def test_a_run_is_called_by_its_levels(by, name):
    assert name_of(series_of(*by)) == name
    assert len(BY) == len(LEVELS)


def test_a_strip_has_a_span_for_each_step():
    figure = levels_over_time({"both": series_of(0, 1, 1, 0), "one": series_of(1, 1, 1, 1)})
    error, strips = figure.axes
    assert [line.get_label() for line in error.lines] == ["both", "one"]
    np.testing.assert_allclose(error.lines[0].get_ydata(), np.arange(5))
    assert error.lines[1].get_color() == LEVELS["projected step"] != error.lines[0].get_color()
    drawn = [
        (to_hex(bars.get_facecolor()[0]), path.vertices[:, 0].min(), path.vertices[:, 1].mean().round())
        for bars in strips.collections
        for path in bars.get_paths()
        if len(path.vertices) and bars.get_label().startswith("_")
    ]
    operators, projected, _ = (color.lower() for color in LEVELS.values())
    expected = [(operators, 0.0), (operators, 0.3), (projected, 0.1), (projected, 0.2)]
    assert [(color, pytest.approx(t)) for color, t, row in drawn if row == 0] == expected
    assert {color for color, _, row in drawn if row == 1} == {projected}


def test_runs_by_one_solver_alone_differ_in_their_dashes():
    figure = levels_over_time({"one": series_of(0, 1), "two": series_of(1, 1), "three": series_of(1, 1)})
    two, three = figure.axes[0].lines[1:]
    assert two.get_color() == three.get_color()
    assert two.get_linestyle() != three.get_linestyle()
    legend = {text.get_text() for text in figure.legends[0].get_texts()}
    assert {"one", "two", "three"} <= legend


def test_a_picture_names_what_operators_of_one_scene_set(tmp_path, monkeypatch):
    told = []
    draw = levels_over_time
    monkeypatch.setattr(levels, "levels_over_time", lambda runs: told.append(list(runs)) or draw(runs))
    alone, one = variant("auto", series_of(1, 1, 1)), variant("one", series_of(0, 1, 1), setting="seed=0")
    teaching = "seed=0, engine.teacher=runs, engine.teaching.unroll=64"
    other = variant("other", series_of(0, 1, 1), setting=teaching)
    levels_section([alone, one, other], tmp_path)
    levels_section([alone, other], tmp_path)
    mixed = "operators and projected step"
    named = ["projected step alone", mixed, f"{mixed}, teacher=runs, unroll=64"]
    assert told == [named, named[:2]]  # without another there is nothing to tell apart
    figure = levels_over_time({name: series_of(0, 1) for name in named})
    labels = [label.get_text() for label in figure.axes[1].get_yticklabels()]
    assert max(len(line) for label in labels for line in label.split("\n")) <= 34
    assert " ".join(labels[2].split()) == named[2]


def test_a_picture_where_a_run_has_more_than_one_level(tmp_path):
    alone = [variant("auto", series_of(1, 1, 1)), variant("operators", series_of(0, 0, 0))]
    assert levels_section(alone, tmp_path) == []
    assert levels_section([variant("old", series_of(0, 1, 0).drop(columns="by"))], tmp_path) == []
    both = variant("levels", series_of(0, 0, 0, parameter=0.5), series_of(0, 1, 0))
    (section,) = levels_section([*alone, both, variant("other", series_of(0, 1, 1), scene="sand")], tmp_path)
    one, two = section.pictures
    assert one.runs == ["evaluate/auto", "evaluate/levels", "evaluate/operators"]
    assert "speed 0.6 m/s" in one.caption
    assert two.runs == ["evaluate/other"]
    assert {path.name for path in tmp_path.glob("*.png")} == {"jelly_cube-levels.png", "sand-levels.png"}
    seeded = [variant(f"levels {seed}", series_of(0, 1, 0), seeds=[f"seed={seed}"]) for seed in (0, 1)]
    ((picture,),) = (section.pictures for section in levels_section(seeded, tmp_path))
    assert picture.runs == ["evaluate/levels 0"]  # of the seed that is shown alone


def timed(engine, stages, device="cpu"):
    row = {"method": "nsf", "field": "basis", "r": 6, "precision": "fp64", "device": device, "engine": engine}
    breakdown = {"reduced": dict.fromkeys(stages, 0.5), "full_order": {"p2g": float(len(stages))}}
    return SimpleNamespace(
        rows=pd.DataFrame([row]), breakdown=breakdown, timed="a step's", alike=("sand", "")
    )


def test_beside_operators_stand_the_stages_of_the_projected_step():
    operators, other = (timed("operators", ["recurrence"], device) for device in ("cpu", "cuda:0"))
    modal = timed("modal", ["inference", "p2g", "inversion"])
    lend_stages([operators, other, modal])
    assert list(operators.breakdown["reduced"]) == ["inference", "p2g", "inversion"]
    assert operators.breakdown["full_order"] == {"p2g": 1.0}  # its own
    assert operators.timed == "the projected step's"
    assert list(other.breakdown["reduced"]) == ["recurrence"]  # measured on another device
    assert modal.timed == other.timed == "a step's"
