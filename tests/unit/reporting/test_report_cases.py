"""Errors over the parameters of scenes with several: charts, maps, and what tells bodies apart."""

import json
from types import SimpleNamespace

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest
from synthetic import Made, seal, write_run

from nsf.data import Case
from nsf.reporting import build_report, rivals
from nsf.reporting.drawing.cases import Cases, Parameter, error_maps, error_over_parameters
from nsf.reporting.rivals import solvers
from nsf.reporting.sections import cases as section
from nsf.reporting.sections.cases import _names
from nsf.reporting.sections.variant import Variant
from nsf.reporting.sources import Study, open_sources
from nsf.reporting.study import _held_out
from nsf.reporting.tables import VARIANT, first_rows, merge, told_apart, variant_labels

E, DENSITY = Parameter("E", "Pa", True), Parameter("density", "kg/m³", False)
TRAINED = [{"E": 4000.0, "density": 80.0, "program": 0.0}, {"E": 8000.0, "density": 120.0, "program": 1.0}]
TESTED = [{"E": 4500.0, "density": 110.0}, {"E": 7000.0, "density": 90.0}]
TINY = Made(scene="block", particles=30, frames=4, parameters=(22.5, 27.5), splits=("test",) * 2, paper=False)


def body(errors: dict, name="block", parameters=(E, DENSITY), trained=2) -> Cases:
    """Cases along a diagonal, of as many as there are errors."""
    found = {}
    for solver, own in errors.items():
        points = np.column_stack([np.geomspace(4000, 8000, len(own)), np.linspace(80, 120, len(own))])
        found[solver] = points[:, : len(parameters)], np.array(own, float)
    return Cases(name, parameters, found, np.full((trained, len(parameters)), 100.0))


def points(panel):
    return [line for line in panel.lines if line.get_marker() == "o"]


def test_a_panel_a_parameter_has_dots_and_means_over_neighbours():
    errors = [0.1, 0.2, 0.6, 0.3, 0.2, 0.1, 0.4, 0.3]
    figure = error_over_parameters([body({"nsf": errors, "few": [0.1, 0.2]})])
    first, second = figure.axes[:2]
    assert (first.get_xlabel(), second.get_xlabel()) == ("E [Pa]", "density [kg/m³]")
    assert (first.get_xscale(), second.get_xscale()) == ("log", "linear")
    for panel in (first, second):
        assert panel.get_ylabel() == "displacement error [%]"
        np.testing.assert_allclose(points(panel)[0].get_ydata(), 100 * np.array(errors))
        (line,) = (line for line in panel.lines if line.get_marker() == "None")  # none of two cases
        np.testing.assert_allclose(line.get_ydata(), [30, 32.5, 30, 25, 25])
        (band,) = panel.collections
        assert band.get_paths()[0].vertices[:, 1].max() == pytest.approx(60)
    assert first.lines[1].get_xdata()[0] == pytest.approx(np.prod(np.geomspace(4000, 8000, 8)[:4]) ** 0.25)


def test_a_lost_run_is_a_cross_above_the_panel_and_no_part_of_a_mean():
    (panel, *_) = error_over_parameters([body({"nsf": [np.inf, 0.1, 0.1, 0.1, 0.1, 0.1, 0.1, 11.0]})]).axes
    (crosses,) = (line for line in panel.lines if line.get_marker() == "X")
    np.testing.assert_allclose(crosses.get_xdata(), [4000, 8000])
    assert panel.get_xlim()[0] < 4000 < 8000 < panel.get_xlim()[1]
    (line,) = (line for line in panel.lines if line.get_marker() == "None")
    np.testing.assert_allclose(line.get_ydata(), [np.nan, 10, 10, 10, np.nan])


@pytest.mark.filterwarnings("error")
def test_a_chart_of_lost_runs_alone_is_drawn(tmp_path):
    lost = [body({"nsf": [np.inf, np.nan]}, trained=0)]
    for figure in (error_over_parameters(lost), error_maps(lost)):
        figure.savefig(tmp_path / "x.png")


def test_maps_show_the_best_first_on_one_scale_beside_the_training_cases():
    both = {"bad": [0.4, 0.8], "lost": [0.1, np.inf], "good": [0.1, 0.4]}
    figure = error_maps([body(both, "elastic"), body({"good": [0.2, 0.4]}, "plastic")])
    shown = [panel for panel in figure.axes if panel.texts]
    told = [panel.texts[0].get_text() for panel in shown]
    assert told == ["good\nmean 25 %", "bad\nmean 60.0 %", "lost\n1 of 2 lost", "good\nmean 30.0 %"]
    assert [panel.get_title("left") for panel in shown] == ["elastic", "", "", "plastic"]
    colors = [panel.collections[0].get_facecolors().tolist() for panel in shown]
    assert colors[0][1] == colors[1][0] == colors[3][1] != colors[0][0] == colors[2][0]
    for panel in shown:
        assert (panel.get_xscale(), panel.get_yscale()) == ("log", "linear")
        assert panel.get_xlabel() == "E [Pa]"
        (trained,) = (line for line in panel.lines if line.get_marker() == "x")
        assert len(trained.get_xdata()) == 2
    assert shown[0].get_ylabel() == shown[3].get_ylabel() == "density [kg/m³]"
    (lost,) = (line for line in shown[2].lines if line.get_marker() == "X" and len(line.get_xdata()))
    assert (lost.get_xdata().item(), lost.get_ydata().item()) == (8000, 120)
    assert figure.axes[-1].get_ylabel() == "displacement error [%]"
    legend = [text.get_text() for text in figure.legends[0].get_texts()]
    assert legend == ["held-out case", "lost", "training case"]


def deployed(root, material: str):
    """A deploy run with a material, and the runs that it goes back to."""
    from nsf.runs import Run

    def recorded(stage, config, parents=(), files=None):
        run = Run.open(stage, "block", config, parents, root)
        with run.record() as record:
            for name, text in (files or {}).items():
                (run.path / name).write_text(text)
                record.output(name)
        return run

    trained = [
        recorded(
            "simulate",
            {"law": {"of": material}, "parameters": {n: {"key": n, "value": v} for n, v in c.items()}},
        )
        for c in TRAINED
    ]
    train = recorded("train", {"seed": 0}, trained)
    text = "scene: {parameters: {E: {unit: Pa, log: true}, density: {unit: kg/m³}}}"
    config = {"material": {"_target_": f"nsf.mpm.materials.{material}"}}
    return recorded("deploy", config, [train], {"configuration.yaml": text})


def block(root, material: str | None, noise=0.004, seed=0, programs=True, **made):
    """A run at `TESTED`, of programs that no other case has."""
    parents = [deployed(root, material)] if material else []
    own = Made(**vars(TINY) | {"noise": noise, "seed": seed} | made)
    run = write_run(root, own, parents)
    cases = [
        Case.of(c | ({"program": 7.0} if programs else {}), ("Pa", "kg/m³", "")[: 2 + programs])
        for c in TESTED
    ]
    texts = dict(zip(TINY.parameters, (case.text for case in cases), strict=True))
    for name in ("results.csv", "series.csv"):
        frame = pd.read_csv(run.path / name)
        frame.assign(parameter=frame["parameter"].map(texts)).to_csv(run.path / name, index=False)
    with np.load(run.path / "frames.npz") as stored:
        arrays = dict(stored) | {"parameters": np.array([*texts.values()])}
    np.savez(run.path / "frames.npz", **arrays)
    seal(run)
    return run


def test_a_run_tells_its_material_design_and_training_cases(tmp_path):
    (source,) = open_sources([block(tmp_path, "VonMisesHardening")])
    assert source.material == "von_mises_hardening"
    assert source.logarithmic == {"E"}
    assert source.training_cases == TRAINED
    (alone,) = open_sources([block(tmp_path, None)])
    assert (alone.material, alone.logarithmic, alone.training_cases) == ("", set(), [])


def test_what_was_changed_after_the_run_is_not_read(tmp_path):
    run = block(tmp_path, "VonMises")
    (deploy,) = run.parent_runs
    (deploy.path / "configuration.yaml").write_text("scene: {parameters: {density: {log: true}}}")
    (source,) = open_sources([run])
    assert source.logarithmic == set()
    (deploy.path / "config.yaml").write_text("material: {_target_: other.Other}")
    (source,) = open_sources([run])
    assert (source.material, source.training_cases) == ("", [])


def test_two_materials_of_one_scene_are_two_bodies(tmp_path):
    """Else the newer one would silently take the place of the other."""
    runs = [block(tmp_path, material) for material in ("FixedCorotated", "VonMises")]
    sources = open_sources(runs)
    merged = merge(sources, told_apart(sources))
    assert not merged.superseded
    rows = first_rows(merged)
    assert variant_labels(rows) == ["block · fixed_corotated · nsf", "block · von_mises · nsf"]
    study = Study("?", "", {}, {run.id: {"scene": "block"} for run in runs}, ())
    assert set(_held_out(merged, study)["scene"]) == {row["scene"] for row in rows}
    alone = open_sources(runs[:1])
    assert [row["scene"] for row in first_rows(merge(alone))] == ["block"]


def test_several_numbers_of_particles_of_one_scene_are_several_bodies(tmp_path):
    """Else their full-order times would be one, and one chart of error over time of all sizes."""
    sizes = (300, 1200)
    runs = [write_run(tmp_path, Made(full_order=size)) for size in sizes]
    told = {
        run.id: f"scene.bodies.column.particles={size}, scene.dx=0.1, trainer.steps=9"
        for run, size in zip(runs, sizes, strict=True)
    }
    merged = merge(open_sources(runs), told)
    rows = first_rows(merged)
    assert [row["scene"] for row in rows] == ["sand · 300 particles", "sand · 1,200 particles"]
    assert {row["setting"] for row in rows} == {"trainer.steps=9"}
    assert {row["scene"] for row in first_rows(merged, sized=False)} == {"sand"}
    full = solvers(merged).query("kind == 'full'")
    assert list(full["particles"]) == [300, 1200]
    assert full["scene"].is_unique


def test_time_over_particles_is_drawn_where_a_scene_has_several(tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr(rivals, "step_over_particles", lambda panels: drawn.append(panels) or plt.figure())
    runs = [write_run(tmp_path, Made(full_order=size)) for size in (300, 1200)]
    of = {run.id: f"scene.bodies.column.particles={i}" for i, run in enumerate(runs)}
    for own, expected in ((runs[:1], 1), (runs, 2)):
        pictures = rivals.over_cost(merge(open_sources(own), of), tmp_path, [])
        assert len(pictures) == expected
    ((scene, solvers_there),) = drawn[0].items()
    assert scene == "sand"
    assert {tuple(times) for times in solvers_there.values()} == {(300, 1200)}


def test_operators_that_left_every_run_are_not_drawn(tmp_path, monkeypatch):
    shown = []
    monkeypatch.setattr(section, "error_over_parameters", lambda bodies: shown.extend(bodies) or plt.figure())
    monkeypatch.setattr(section, "error_maps", lambda bodies: plt.figure())
    runs = [block(tmp_path, None), block(tmp_path, None, seed=1)]
    merged = merge(open_sources(runs), {run.id: f"seed={i}" for i, run in enumerate(runs)})
    own = [[i for i, source in enumerate(merged.source) if source.id == run.id] for run in runs]
    merged.frame.loc[own[1], "engine"] = "operators"
    for share, engines, notes in ((1.0, 1, 2), (0.5, 2, 0)):
        merged.frame.loc[own[1], "handed_over"] = share
        groups = [[Variant(merged, members, "")] for members in own]
        (told,) = section.cases_section(groups, tmp_path)
        assert len(shown.pop().errors) == engines
        assert sum("not shown" in picture.caption for picture in told.pictures) == notes


def test_a_picture_says_which_seed_its_worst_case_is_of(tmp_path):
    runs = [block(tmp_path, None), block(tmp_path, None, seed=1)]
    merged = merge(open_sources(runs), {run.id: f"seed={i}" for i, run in enumerate(runs)})
    members = [i for i, source in enumerate(merged.source) if source.id == runs[1].id]
    places = [
        [case.place for case in Variant(merged, members, name).cases(2)] for name in ("nsf · seed=1", "nsf")
    ]
    assert places == [["worst of seed 1", "best of seed 1"], ["worst", "best"]]


def test_what_tells_bodies_apart_names_no_solver():
    def solver(scene, field):
        row = dict.fromkeys(VARIANT, "") | {"scene": scene, "method": "nsf", "field": field, "r": 6}
        return SimpleNamespace(rows=pd.DataFrame([row]))

    assert _names([[solver("a", "basis")], [solver("b", "mlp")]]) == [["nsf"], ["nsf"]]
    both = [solver("b", "basis"), solver("b", "mlp")]
    told = [["nsf · basis field"], ["nsf · basis field", "nsf · mlp field"]]
    assert _names([[solver("a", "basis")], both]) == told


@pytest.mark.slow
def test_a_report_has_a_chart_a_map_and_pictures_of_each_body(tmp_path, few_pictures, monkeypatch):
    shown = []
    for name in ("error_over_parameters", "error_maps"):
        draw = getattr(section, name)
        monkeypatch.setattr(section, name, lambda bodies, draw=draw: shown.append(bodies) or draw(bodies))
    made = (("FixedCorotated", 0.004, 0), ("FixedCorotated", 0.008, 1), ("VonMises", 0.02, 0))
    runs = {block(tmp_path, m, noise, seed).id: (m, seed) for m, noise, seed in made}
    found = [source.run for source in open_sources([block(tmp_path, m, n, s) for m, n, s in made])]
    settings = {run: f"material={m}, seed={seed}" for run, (m, seed) in runs.items()}
    keys = {run: {"scene": "block", "material": m, "seed": f"{seed}"} for run, (m, seed) in runs.items()}
    study = Study("?", "", settings, keys, ())
    with few_pictures():
        page = build_report(found, tmp_path / "one" / "report", "Block", study=study)
        again = build_report(found, tmp_path / "two" / "report", "Block", study=study)
    (elastic, plastic), maps = shown[:2]
    assert maps == [elastic, plastic]
    assert (elastic.body, plastic.body) == ("block · fixed_corotated", "block · von_mises")
    assert elastic.parameters == [E, DENSITY]
    assert elastic.trained.tolist() == [[4000, 80], [8000, 120]]
    ((points, errors),) = elastic.errors.values()
    assert points.tolist() == [[case["E"], case["density"]] for case in TESTED]
    rows = pd.read_csv(page.parent / "results.csv")
    own = rows[rows["setting"].str.contains("FixedCorotated")]
    np.testing.assert_allclose(errors, own.groupby("parameter")["displacement_error"].mean())  # over seeds
    assert list(elastic.errors) == list(plastic.errors) == ["nsf"]
    folder = page.parent
    drawn = [f"{stem}.{kind}" for stem in ("error-map", "error-over-parameters") for kind in ("png", "svg")]
    for name in (*drawn, "block-von_mises-nsf-strip.png"):
        assert (folder / name).read_bytes() == (again.parent / name).read_bytes()
    told = json.loads((folder / "sources.json").read_text())
    assert set(told["pictures"]["error-map.png"]) == set(runs)
    text = (folder / "index.md").read_text()
    rows = [row.split(" | ") for row in text.splitlines() if row.startswith("| block")]
    assert {row[0] for row in rows} == {"| block · fixed_corotated", "| block · von_mises"}
    assert "material=" not in text[: text.index("## Where the numbers come from")]
    assert (
        text.index("## Over the parameters") < text.index("](error-map.png)") < text.index("## All variants")
    )


@pytest.mark.parametrize(("parameter", "drawn"), [("speed=3 m/s, program=4", 1), ("program=4, program=5", 0)])
def test_a_program_is_no_axis_and_one_parameter_has_no_map(tmp_path, few_pictures, parameter, drawn):
    run = block(tmp_path, None)
    for name in ("results.csv", "series.csv"):
        frame = pd.read_csv(run.path / name)
        frame["parameter"] = frame["parameter"].replace(
            Case.of(TESTED[0] | {"program": 7.0}, ("Pa", "kg/m³", "")).text, parameter
        )
        frame[frame["parameter"] == parameter].to_csv(run.path / name, index=False)
    seal(run)
    with few_pictures():
        folder = build_report([run], tmp_path / "report", "Block").parent
    assert len(list(folder.glob("error-over-parameters.png"))) == drawn
    assert not list(folder.glob("error-map.*"))


@pytest.mark.slow
def test_a_scene_with_numbers_for_cases_has_neither(report):
    assert not [path for stem in ("error-map", "error-over-parameters") for path in report.glob(f"{stem}*")]
