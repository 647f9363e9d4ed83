"""What an experiment varies: δ over numbers with bands, over seeds; and the table for LaTeX."""

import json
import re
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from synthetic import Made, write_run

from nsf.reporting import build_report
from nsf.reporting.bodies import shapes
from nsf.reporting.drawing import charts
from nsf.reporting.pictures import draw
from nsf.reporting.sources import Study, open_sources
from nsf.reporting.study import _name, _settings, _told, interval, over_seeds, swept
from nsf.reporting.tables import means, merge, rows_of
from nsf.reporting.text.columns import brief, counted, distinct, plus_minus, telling
from nsf.results.formats import latex, latex_table

VALUES = (22.5, 27.5)


def runs(root, **made):
    """A run of each combination, with the keys of its job."""
    found, keys, settings = [], {}, {}
    for size, noise in made.get("sizes", {150: 0.004}).items():
        for seed in made.get("seeds", ("0",)):
            own = Made(particles=30, frames=4, parameters=VALUES, splits=("test",) * 2, sample=size)
            own.noise, own.seed, own.scene = (
                noise * (1 + 0.2 * int(seed)),
                int(seed),
                made.get("scene", "sand"),
            )
            run = write_run(root, own)
            found.append(run)
            settings[run.id] = f"seed={seed}"
            keys[run.id] = {"scene": own.scene, "sampler.size": f"{size}", "sampler": "random", "seed": seed}
    return found, keys, settings


def of(keys, printed=None):
    """The study of these jobs."""
    return Study("?", "", {}, keys, (), printed)


@pytest.fixture
def drawn(monkeypatch):
    """The arguments of each chart drawn."""
    calls = []

    def catch(name):
        draw = getattr(charts, name)
        monkeypatch.setattr(charts, name, lambda *a, **k: calls.append((name, a)) or draw(*a, **k))

    catch("delta_over")
    catch("delta_per_variant")
    return calls


def test_delta_over_what_varies_with_every_value_and_seed(tmp_path, drawn):
    found, keys, settings = runs(tmp_path, sizes={20: 0.02, 50: 0.008, 150: 0.004}, seeds=("0", "1", "2"))
    merged = merge(open_sources(found), settings)
    (section,) = swept(merged, of(keys), tmp_path)
    ((name, (panels, x, papers)),) = drawn
    assert (name, x) == ("delta_over", "sample particles |S| [–]")
    assert (list(panels), list(panels["sand"]), papers["sand"][0][0]) == (["sand"], ["mean"], 150)
    line = panels["sand"]["mean"]
    assert {at: len(values) for at, values in line.items()} == {20: 6, 50: 6, 150: 6}
    assert sorted(line[20]) == sorted(merged.frame.loc[merged.frame["sample"] == "20", "delta"])
    (picture,) = section.pictures
    assert picture.files == ["delta-over-sampler-size.svg", "delta-over-sampler-size.png"]
    assert "and seeds (band)" in picture.caption
    assert set(picture.runs) == {run.id for run in found}


def test_seeds_are_summed_up_for_each_setting(tmp_path):
    found, keys, settings = runs(tmp_path, sizes={20: 0.02, 50: 0.008}, seeds=("0", "1", "2"))
    merged = merge(open_sources(found), settings)
    (table,) = over_seeds(merged, of(keys))
    assert [row[:3] for row in table.content.body] == [
        [f"sample particles |S| {size}", "seed", "3"] for size in (20, 50)
    ]
    own = merged.frame[merged.frame["sample"] == "20"].groupby("setting")["delta"].mean()
    assert table.content.body[0][3] == plus_minus(own.mean(), own.std(), 100)
    assert "±" in table.content.body[0][3]
    low, high = map(float, table.content.body[0][-1].split(" to "))
    assert low <= 100 * own.mean() <= high
    alone = {id: {**known, "seed": "0"} for id, known in keys.items()}
    assert over_seeds(merged, of(alone)) == []


def test_an_interval_holds_the_mean_of_as_many_as_it_says():
    """Of normal values whose seeds and cases scatter independently, 95 of 100 hold the true mean."""
    generator, held = np.random.default_rng(1), 0
    for _ in range(200):
        values = generator.normal(1, 0.1, (20, 1)) + generator.normal(0, 0.1, (1, 20))
        low, high = interval(values)
        held += low <= 1 <= high
    assert 0.87 <= held / 200 <= 0.99


def test_delta_over_training_has_its_time_where_every_run_tells_it(tmp_path, drawn):
    made = Made(particles=30, frames=4, parameters=VALUES, splits=("test",) * 2)
    found = [write_run(tmp_path, replace(made, training_seconds=s, noise=1 / s)) for s in (10, 40, 250)]
    steps = dict(zip((run.id for run in found), ("100", "500", "3000"), strict=True))
    keys = {name: {"scene": "sand", "trainer.steps": taken} for name, taken in steps.items()}
    merged = merge(open_sources(found), steps)
    swept(merged, of(keys), tmp_path)
    ((_, (panels, x, _)),) = drawn
    assert (x, sorted(panels["sand"]["mean"])) == ("training time [s]", [10, 40, 250])
    for name in keys:  # of several seeds, the mean
        keys[name] |= {"trainer.steps": "100" if steps[name] == "500" else steps[name], "seed": steps[name]}
    swept(merged, of(keys), tmp_path)
    assert sorted(drawn[1][1][0]["sand"]["mean"]) == [25, 250]
    for name in keys:
        keys[name] = {"scene": "sand", "trainer.steps": steps[name]}
    *_, other = keys  # another schedule, which has epochs in place of steps
    schedule = {"scene": "sand", "trainer": "paper", "trainer.epochs_stress": "2"}
    (section,) = swept(merged, of(keys | {other: schedule}), tmp_path)
    lines = drawn.pop()[1][0]["sand"]
    assert {name: sorted(line) for name, line in lines.items()} == {"mean": [10, 40], "trainer paper": [250]}
    assert "sets no steps" in section.pictures[0].caption
    assert "Times are of" not in section.pictures[0].caption
    merged.frame.loc[merged.frame.index[-1], "device"] = "NVIDIA H200"
    (section,) = swept(merged, of(keys), tmp_path)
    caption = section.pictures[0].caption
    assert "sets no steps" not in caption
    assert "and NVIDIA H200, as the table says" in caption
    drawn.pop()
    for source in merged.source:
        source.cost["trials"] = 0  # side by side, whose times tell nothing
    swept(merged, of(keys), tmp_path)
    _, (panels, x, _) = drawn[2]
    assert (x, sorted(panels["sand"]["mean"])) == ("training steps of each network [–]", [100, 500, 3000])
    swept(merged, of(keys | {other: schedule}), tmp_path)
    assert {name: sorted(line) for name, line in drawn[3][1][0]["sand"].items()} == {"mean": [100, 500]}


def test_an_interval_of_equal_values_is_a_point_and_of_lost_runs_none():
    assert interval(np.full((3, 2), 0.25)) == (0.25, 0.25)
    assert np.isnan(interval(np.array([[0.1, np.inf], [0.1, 0.1]]))).all()


def test_what_the_paper_prints_of_single_jobs_stands_beside_them(tmp_path, drawn):
    found, keys, settings = runs(tmp_path, sizes={20: 0.02, 50: 0.008, 150: 0.004}, seeds=("0", "1"))
    merged = merge(open_sources(found), settings)
    entries = [
        {"scene": "sand", "sampler.size": size, "delta": at} for size, at in (("20", 0.03), ("50", 0.01))
    ]
    study = of(keys, entries)
    swept(merged, study, tmp_path)
    ((_, (_, _, papers)),) = drawn
    assert sorted(papers["sand"]) == [[20.0, 0.03], [50.0, 0.01]]
    table = means(merged, study)
    printed = table[table["field"] == "the paper"]
    assert printed[["sample", "delta"]].to_numpy().tolist() == [["20", 0.03], ["50", 0.01]]
    assert len(means(merged)) == len(table) - 1  # the scene's figure alone


def test_a_setting_tells_the_key_of_a_number_and_a_material_once():
    setting = {
        "scene": "block · von_mises",
        "material": "von_mises",
        "deploy.error_ratio": "1.25",
        "field.beta": 8,
        "field.noise": "1e-05",
    }
    assert _name(setting) == "block · von_mises · error ratio 1.25 · hidden width β over d 8 · noise 1e-05"
    assert _name({"engine": "operators", "deploy.error_ratio": "null"}) == "operators · error ratio null"


def test_seeds_alone_are_dots(tmp_path, drawn):
    found, keys, settings = runs(tmp_path, seeds=("0", "1", "2"))
    merged = merge(open_sources(found), settings)
    (section,) = swept(merged, of(keys), tmp_path)
    ((name, (entries,)),) = drawn
    assert name == "delta_per_variant"
    (entry,) = entries
    assert (entry["label"], len(entry["values"])) == ("sand · 3 × seed", 3)
    assert entry["mean"] == pytest.approx(merged.frame["delta"].mean())
    assert section.pictures[0].files[0] == "delta-over-seeds.svg"


def test_nothing_varied_draws_nothing(tmp_path):
    found, keys, _ = runs(tmp_path)
    assert swept(merge(open_sources(found)), of(keys), tmp_path) == []


def test_lines_are_named_by_what_tells_them_apart():
    """A key that goes with another one adds nothing to the name."""
    frame = pd.DataFrame(
        {"scene": "sand", "field": ["basis", "mlp"], "trainer.steps": [None, "null"], "x": 1.0, "run": "a"}
    )
    told = _told(frame, ())
    assert told == ["field"]
    assert [name for name, _ in _settings(frame, told, "mean")] == ["basis", "mlp"]
    frame["field"] = ["basis", None]
    assert [name for name, _ in _settings(frame, told, "mean")] == ["basis", "mean"]


def test_a_setting_has_one_name_in_every_scene(tmp_path, drawn):
    """Also in a scene that has it alone."""
    found, keys, settings = [], {}, {}
    for scene, fields in (("metal", ["basis"]), ("sand", ["basis", "mlp"])):
        for field in fields:
            for beta in ("16", "8"):
                own = Made(particles=30, frames=4, parameters=VALUES, splits=("test",) * 2, scene=scene)
                run = write_run(tmp_path, replace(own, field=field, seed=int(beta)))
                found.append(run)
                keys[run.id] = {"scene": scene, "field": field, "field.beta": beta}
                settings[run.id] = f"field.beta={beta}"
    merged = merge(open_sources(found), settings)
    swept(merged, of(keys), tmp_path)
    ((name, (panels, *_)),) = drawn
    assert name == "delta_over"
    assert {scene: list(lines) for scene, lines in panels.items()} == {
        "metal": ["basis"],
        "sand": ["basis", "mlp"],
    }
    assert list(dict.fromkeys(merged.frame["setting"])) == ["field.beta=8", "field.beta=16"]


def test_the_band_spans_the_values_and_a_diverged_run_leaves_a_gap():
    line = {10.0: [0.02, 0.04], 20.0: [0.01, np.inf], 1000.0: [0.01, 0.02]}
    figure = charts.delta_over({"sand": {"random": line}}, "|S| [–]", {})
    (panel,) = figure.axes
    np.testing.assert_allclose(panel.lines[0].get_ydata(), [3.0, np.nan, 1.5])
    corners = panel.collections[0].get_paths()[0].vertices[:, 1]
    assert (corners.min(), corners.max()) == pytest.approx((2.0, 4.0))
    assert (panel.get_xscale(), figure.get_supxlabel(), panel.get_ylabel()) == ("log", "|S| [–]", "δ [%]")
    (panel,) = charts.delta_over({"sand": {"alone": {10.0: [0.02, 0.04]}}}, "|S| [–]", {}).axes
    (span,) = panel.collections[1].get_segments()
    np.testing.assert_allclose(span, [[10, 2], [10, 4]])


def test_more_than_four_scenes_take_a_second_row():
    scenes = [f"scene {k}" for k in range(6)]
    figure = charts.delta_over({scene: {"mean": {1.0: [0.1], 2.0: [0.2]}} for scene in scenes}, "r [–]", {})
    drawn = [panel for panel in figure.axes if panel.axison]
    assert [panel.get_title("left") or panel.get_title() for panel in drawn] == scenes
    assert [panel.get_subplotspec().rowspan.start for panel in drawn] == [0, 0, 0, 0, 1, 1]


def test_latex_is_the_first_table_of_the_page(tmp_path, no_pictures):
    found, keys, settings = runs(tmp_path, sizes={20: 0.02, 150: 0.004})
    study = Study("How many?", "Two.", settings, keys, [])
    folder = build_report(found, tmp_path / "report", "Sand & 50 %", study=study).parent
    lines = (folder / "results.tex").read_text().splitlines()
    page = (folder / "index.md").read_text()
    assert "![Mean δ" in page
    first = page.index("Results beside")
    rows = re.findall(r"^\| (.*) \|$", page[first : page.index("##", first)], re.MULTILINE)
    body = [line for line in lines if line.endswith(r" \\")]
    assert len(body) == len(rows) - 1  # without the rule under the headings
    assert body[0].startswith("method & ")
    assert r"\textbar{}S\textbar{}" in body[0]
    assert r"$\delta$ [\%]" in body[0]
    assert any("the paper" in line for line in body)
    assert {len(line.split(" & ")) for line in body} == {len(rows[0].replace("\\|", "").split("|"))}
    assert lines[-1] == r"\end{tabular}"


def test_sources_tell_what_a_study_varied_and_its_chart(tmp_path, no_pictures):
    found, keys, settings = runs(tmp_path, sizes={20: 0.02, 150: 0.004})
    printed = ({"sampler.size": "20", "delta": 0.005},)
    study = Study("How many?", "Two.", settings, keys, ["one: not run"], printed)
    folder = build_report(found, tmp_path / "report", "t", study=study).parent
    told = json.loads((folder / "sources.json").read_text())
    assert {run: told["runs"][run]["keys"] for run in keys} == keys
    assert {entry["scale"] for entry in told["runs"].values()} == {"paper"}
    assert (told["paper"], told["missing"], told["printed"]) == ("Two.", ["one: not run"], list(printed))
    assert told["chart"]["file"] == "delta-over-sampler-size.png"
    assert told["chart"]["caption"].startswith("Mean δ")


def test_sources_without_a_study(report):
    told = json.loads((report / "sources.json").read_text())
    assert (told["paper"], told["missing"], told["printed"]) == (None, [], None)
    assert {json.dumps(entry["keys"]) for entry in told["runs"].values()} == {"{}"}
    assert told["chart"]["file"] == "delta.png"


def test_latex_escapes():
    assert latex("a_b & 5 % ≤ |S| – 1×") == r"a\_b \& 5 \% ≤ \textbar{}S\textbar{} -- 1$\times$"
    assert latex("\\{") == r"\textbackslash{}\{"


def test_latex_knows_every_sign_of_a_table(sweep):
    text = latex_table(rows_of(means(merge(open_sources(sweep)))), "Sand", "")
    assert text.isascii()


@pytest.mark.slow
def test_bodies_at_each_setting_stand_below_each_other(tmp_path, monkeypatch):
    seen = []
    draw_shapes = shapes.final_shapes
    monkeypatch.setattr(
        shapes, "final_shapes", lambda cases, *a: seen.append(cases) or draw_shapes(cases, *a)
    )
    found, keys, settings = runs(tmp_path, sizes={20: 0.02, 150: 0.004}, seeds=("0", "1"))
    merged = merge(open_sources(found), settings)
    (section,) = [s for s in draw(merged, tmp_path, True, of(keys)) if s.heading == "Bodies at each setting"]
    (picture,) = section.pictures
    assert picture.files == ["sand-settings.png"]
    assert (tmp_path / "sand-settings.png").is_file()
    cases = seen[-1]
    assert [case.place for case in cases] == ["sampler.size=20", "sampler.size=150"]
    assert len({case.motion.parameter for case in cases}) == 1
    assert cases[0].delta > cases[1].delta


@pytest.mark.slow
def test_seeds_are_no_settings(tmp_path):
    found, keys, settings = runs(tmp_path, seeds=("0", "1"))
    sections = draw(merge(open_sources(found), settings), tmp_path, True, of(keys))
    assert "Bodies at each setting" not in [section.heading for section in sections]


@pytest.mark.slow
def test_a_sweep_of_the_baseline_alone_has_no_bodies_of_settings(tmp_path):
    made = [Made(method="deformation_only", sample=size) for size in (20, 150)]
    found = [write_run(tmp_path, one) for one in made]
    keys = {run.id: {"sampler.size": str(one.sample)} for run, one in zip(found, made, strict=True)}
    sections = draw(merge(open_sources(found)), tmp_path, True, of(keys))
    assert "Bodies at each setting" not in [section.heading for section in sections]


def test_a_long_list_is_told_by_its_ends_and_its_length():
    values = ",".join(map(str, range(25)))
    assert brief(f"design.train=[{values}], seed=0") == "design.train=[0 to 24, 25 values], seed=0"
    assert brief("evaluation.values=[1,2,3,4,5,6]") == "evaluation.values=[1,2,3,4,5,6]"


def test_lists_that_differ_keep_names_that_differ():
    lists = ["[0,5,10,15,20,25,28]", "[0,1,2,3,26,27,28]"]
    assert distinct(lists) == lists
    assert distinct([*lists[:1], "[1,2]", lists[0]]) == [
        "[0 to 28, 7 values]",
        "[1,2]",
        "[0 to 28, 7 values]",
    ]


def test_training_runs_are_counted_unless_two_lists_have_one_length():
    scenes = ["sand", "sand", "cake"]
    assert counted(["[1,2]", "[1,2,3]", "[5,6]"], scenes) == [2, 3, 2]
    assert counted(["[1,2]", "[1,3]", "[5,6]"], scenes) == ["[1,2]", "[1,3]", "[5,6]"]
    assert counted(["8", "[1,2]", None], scenes) == ["8", 2, None]


def test_no_key_is_told_that_tells_no_more_than_those_before_it():
    modal = {"engine": "modal", "seed": "0"}
    operators = {"engine": "operators", "seed": "0", "engine.teacher": "runs"}
    more = {**operators, "scene.design.train": "[1,2]"}
    keys = dict.fromkeys(key for setting in (modal, operators, more) for key in setting)
    assert telling([modal, operators, more], keys) == ["engine", "scene.design.train"]
    assert telling([modal, operators, more], keys, beside=["engine.teacher"]) == ["scene.design.train"]
    assert telling([modal], modal) == telling([], keys) == []
    rows = pd.DataFrame({"a": [np.nan] * 2, "b": ["x", "y"]}).to_dict("records")
    assert telling(rows, ["a", "b"]) == ["b"]


def test_over_training_runs_stands_the_error_of_interpolating_them(tmp_path, drawn):
    lists = ("[21,38.5]", "[21,29.75,38.5]")
    made = [
        Made(
            particles=30, frames=4, parameters=VALUES, splits=("test",) * 2, noise=noise, seed=i, rivals=True
        )
        for i, noise in enumerate((0.008, 0.004))
    ]
    found = [write_run(tmp_path, one) for one in made]
    keys = {
        run.id: {"scene": "sand", "scene.design.train": one} for run, one in zip(found, lists, strict=True)
    }
    settings = {run.id: f"scene.design.train={one}" for run, one in zip(found, lists, strict=True)}
    merged = merge(open_sources(found), settings)
    merged.frame["displacement_error"] = 20 * merged.frame["delta"]
    merged.frame.loc[0, ["delta", "displacement_error"]] = np.inf  # a run that diverged
    swept(merged, of(keys), tmp_path)
    ((_, (panels, x, _)),) = drawn
    assert x == "training runs [–]"
    assert {name: tuple(line) for name, line in panels["sand"].items()} == {
        "reduced": (2, 3),
        "interpolated latents": (2, 3),
    }
    shown = sorted(value for values in panels["sand"]["interpolated latents"].values() for value in values)
    np.testing.assert_allclose(shown, sorted(merged.frame["displacement_interpolated"] / 20))
