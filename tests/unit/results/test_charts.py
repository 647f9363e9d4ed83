"""Every chart draws what its table has, with a unit on each axis, and nothing where it has none of it."""

import re

import numpy as np
import pandas as pd
import pytest
from made import STAGES, Made, frame

from nsf.results import style, table
from nsf.results.charts import CHARTS, View, cases, drawing, errors
from nsf.results.charts import view as register

PLANE = tuple(
    f"E={e} Pa, density={d} kg/m³, program={p}" for p, (e, d) in enumerate(((5, 1), (6, 2), (7, 3)))
)
#: What each chart needs to have something to draw.
NEEDS = {
    "error_bounds": {"error_bound": [0.02, 0.03, 0.04, 0.05], "fallback_share": 0.0},
    "programs": {"case": [*PLANE, PLANE[0].replace("program=0", "program=9")]},
    "delta_over": {"setting": ["sampler.size=12", "sampler.size=50"] * 2},
    "step_over_particles": {"particles": [1000, 1000, 9000, 9000]},
    "error_over_parameters": {"case": [*PLANE, PLANE[0].replace("program=0", "program=9")]},
    "error_map": {"case": [*PLANE, PLANE[0].replace("program=0", "program=9")]},
}


def view(**columns) -> View:
    rows = table.labelled(table.complete(frame(Made(), Made(r=8)).assign(**columns), "here"))
    rows["run"] = "evaluate/sand/1"
    series = []
    for row in rows.to_dict("records"):
        t = np.linspace(0, 0.2, 5)
        errors = dict.fromkeys(("delta", "displacement_error", "stress_error"), 0.01 * t)
        kept = {name: row[name] for name in ("run", "body", "variant", "model_name", "case")}
        series.append(pd.DataFrame(kept | errors | {"t": t, "xhat_1": t, "encoded_1": t}))
    stages = {f"{body} · {kind}": STAGES for body, kind in zip(rows["body"], rows["variant"], strict=True)}
    trained = {"sand": [{"E": 5.0, "density": 2.0}]}
    return View(rows, pd.concat(series), stages | {"full order": STAGES}, trained)


@pytest.mark.parametrize("name", CHARTS)
def test_a_chart_draws_something_with_units(name):
    figures = CHARTS[name].draw(view(**NEEDS.get(name, {})))
    assert figures
    for figure in figures.values():
        panels = [panel for panel in figure.axes if panel.has_data() and panel.axison]
        assert panels
        labels = [text for panel in panels for text in (panel.get_xlabel(), panel.get_ylabel()) if text]
        shared = figure.get_supxlabel()
        counts = ("sample particles |S|", "particles", "r")  # numbers have no unit
        for label in (*labels, *([shared] if shared else [])):
            assert re.search(r"\[[^\]]+\]$", label) or label in counts, label


@pytest.mark.parametrize("name", sorted(set(CHARTS) - {"delta"}))
def test_a_chart_is_left_out_where_there_is_nothing_of_its_kind(name):
    rows = table.labelled(table.complete(frame(Made(timed=False)), "here"))
    assert CHARTS[name].draw(View(rows)) == {}


def test_every_program_is_a_dot_beside_its_rivals():
    rows = table.labelled(table.complete(frame(Made((0.01, np.inf), PLANE[:2])), "here"))
    panel = errors.programs(View(rows))["programs"].axes[0]
    lines = [line for line in panel.lines if len(line.get_ydata())]  # others are of the legend
    dots = {y: line.get_xdata() for line in lines if (y := line.get_ydata()[0]) == line.get_ydata()[-1]}
    names = [text.get_text().replace("\n", " ") for text in panel.get_yticklabels()]
    assert names[:2] == ["projected", "nothing moves"]
    assert len(dots[0]) == 2
    assert max(dots[0]) == panel.get_xlim()[1]  # lost


def test_a_number_that_varies_along_with_another_setting_is_no_axis():
    coupled = ["field.noise=0.1; field.members=4", "field.noise=0.01; field.members=1"] * 2
    crossed = [*coupled[:2], "field.noise=0.01; field.members=4", "field.noise=0.1; field.members=1"]
    drawn = []
    for settings in (coupled, crossed):
        rows = pd.concat([frame(Made(model="projected")).assign(setting=one) for one in settings])
        rows = table.labelled(table.complete(rows.reset_index(drop=True), "here"))
        drawn.append(sorted(errors.delta_over(View(rows))))
    assert drawn == [[], ["delta-over-field-members", "delta-over-field-noise"]]


def test_a_run_that_diverged_leaves_a_gap_and_is_said():
    rows = table.labelled(table.complete(frame(Made((0.01, np.inf)), Made(model="recurrence")), "here"))
    panel = errors.delta(View(rows))["delta"].axes[0]
    assert [text.get_text() for text in panel.texts] == ["diverged"]


def test_the_baseline_has_one_name_in_charts():
    rows = [Made(), Made(stress="deformation", affine="none")]
    shown = View(table.labelled(table.complete(frame(*rows), "here")))
    panel = errors.delta(shown)["delta"].axes[0]
    names = [text.get_text() for text in panel.get_yticklabels()]
    assert names == ["deformation only (baseline)", "projected"]


def test_a_model_has_one_colour_and_its_settings_have_shades_of_it():
    assert len(set(style.MODEL_COLORS.values())) == len(style.MODEL_COLORS)
    rows = table.labelled(table.complete(frame(Made(r=6), Made(r=8), Made(model="recurrence")), "here"))
    of_models, of_variants = (drawing.styles(rows, by) for by in ("model_name", "variant"))
    assert {name: one["color"].upper() for name, one in of_models.items()} == {
        name: style.MODEL_COLORS[name].upper() for name in ("projected", "recurrence")
    }
    assert len({one["color"] for one in of_variants.values()}) == len(of_variants) == 3
    assert style.model_color("a model of one's own") == style.model_color("a model of one's own")


def test_a_chart_is_added_by_one_function(monkeypatch):
    monkeypatch.setattr(register, "CHARTS", {})

    @register.chart("Nothing.")
    def mine(view):
        return {"mine": None}

    assert register.CHARTS["mine"].draw(None) == {"mine": None}
    assert register.CHARTS["mine"].caption == "Nothing."


def test_lost_runs_are_no_colour_of_a_map():
    runs = pd.DataFrame({"error": [0.1, 0.3, np.inf], "lost": [False, False, True], "beyond": False})
    assert cases._summary(runs) == "1 of 3 lost"
    assert cases._summary(runs[:2]) == "mean 20 %"
    assert cases._summary(runs[:2].assign(beyond=[False, True])) == "mean 10 %"


def test_a_name_beside_an_axis_is_part_of_a_chart():
    one, other = (style.figure(2.0) for _ in range(2))
    for fig, name in ((one, "recurrence"), (other, "projected")):
        fig.subplots().set_yticks([0, 1], [name, "gru"])
    assert style.fingerprint(one) != style.fingerprint(other)


def test_ticks_of_a_narrow_logarithmic_axis_stay_apart(tmp_path):
    with style.styled():
        fig = style.figure(1.6)
        panel = fig.subplots(1, 5)[0]
        panel.plot([3900.0, 8100.0], [0.0, 1.0])
        panel.set_xscale("log")
        style.plain_ticks(panel.xaxis)
        style.save(fig, tmp_path, "narrow", ("png",))
    low, high = panel.get_xlim()
    assert [tick for tick in panel.get_xticks() if low <= tick <= high] == [4000.0, 8000.0]
