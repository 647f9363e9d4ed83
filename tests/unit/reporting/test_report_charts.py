"""Charts and pictures: they show the data they are given, name their units, and see what lies in front."""

import itertools
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure
from synthetic import TEST, Made, collapse

from nsf import config
from nsf.bodies.camera import Camera
from nsf.reporting.bodies.shapes import Case, final_shapes, strip
from nsf.reporting.drawing import charts
from nsf.reporting.drawing.cost import error_over_cost, solver_styles, step_over_particles
from nsf.reporting.sources import Motion
from nsf.results.point import point_chart, point_response
from nsf.results.scales import plain_ticks, set_apart
from nsf.results.search import search_chart
from nsf.results.style import LETTER, legend_above, save, styled

RED, BLUE = np.array([1.0, 0, 0]), np.array([0, 0, 1.0])


@pytest.fixture(scope="module")
def series(sweep):
    return pd.read_csv(sweep[0].path / "series.csv")


def motions(count=2, **changes):
    made, rng = replace(Made(), **changes), np.random.default_rng(1)
    t = np.linspace(0, 0.6, made.frames)
    return [Motion(value, "test", t, **collapse(made, rng, value, t)) for value in TEST[:count]]


def labels(figure):
    return [
        text
        for panel in figure.axes
        for text in (panel.get_xlabel(), panel.get_ylabel(), panel.get_title("left"))
    ]


def test_error_over_time_spans_the_run_where_one_diverged_early(series):
    lost = series.copy()
    lost.loc[lost["t"] > 0.1, ["delta", "displacement_error"]] = np.inf
    for panel in charts.error_over_time(lost).axes:
        assert panel.get_xlim()[1] >= series["t"].max()


def test_no_two_solvers_look_alike():
    styles = solver_styles(["nsf · operators engine", *(f"nsf · steps={k}" for k in range(15))])
    assert len({(style["color"], style["marker"]) for style in styles.values()}) == 16


@pytest.mark.parametrize("entries", [1, 3, 13])
def test_panels_keep_their_room_below_a_long_legend(entries):
    with styled():
        fig = Figure(figsize=(9.6, 4.0), dpi=100)
        panel = fig.subplots()
        names = [f"nsf · mlp field · reference engine · trainer.steps={k:05}" for k in range(entries)]
        lines = [panel.plot([0, 1])[0] for _ in names]
        legend_above(fig, lines, names, 4)
        fig.draw_without_rendering()
    assert panel.get_window_extent().height > 250


def test_error_over_cost_has_a_point_for_each_solver_that_was_timed():
    def solver(name, kind, ms, error):
        return {"solver": name, "kind": kind, "span_ms": ms, "displacement_error": error}

    panels = {
        "sand": [
            solver("full order", "full", 2.0, 0.0),
            solver("full order, Δx × 2", "coarse", 0.5, 0.2),
            solver("nsf", "reduced", 1.0, 0.01),
            solver("lost", "reduced", np.nan, np.inf),
        ],
        "bread": [solver("nsf", "reduced", 0.1, 0.03)],
    }
    fig = error_over_cost(panels, {"sand": {"nothing moves": 1.0, "nearest training run": np.nan}})
    sand, bread = fig.axes
    assert [panel.get_title("left") for panel in (sand, bread)] == ["sand", "bread"]
    drawn = {line.get_label(): line.get_xydata().tolist() for line in sand.lines}
    assert drawn["nsf"] == [[1.0, 1.0]]
    assert drawn["full order on coarser grids"] == [[0.5, 20.0]]
    assert [x for x, _ in drawn["full order"]] == [2.0, 2.0]
    assert [y for _, y in drawn["nothing moves"]] == [100.0, 100.0]
    assert set(drawn).isdisjoint({"lost", "nearest training run"})
    assert [text.get_text() for text in sand.texts] == ["2Δx"]
    assert (sand.get_xscale(), sand.get_yscale()) == ("log", "log")
    for text in labels(fig)[:2]:
        assert text.endswith(("[ms]", "[%]"))
    assert sand.lines[2].get_color() == bread.lines[0].get_color()  # one solver, one colour


def test_a_strip_has_the_worst_and_the_best_and_the_baseline_below():
    worst, best = motions(2, particles=60)
    lost = replace(worst, stopped=0.2)
    figure = strip([Case(worst, "worst", 0.03, lost), Case(best, "best", 0.01)], "friction angle", "°")
    told = [text.get_text() for text in figure.texts]
    assert [text for text in told if "angle" in text] == [
        "full-order, friction angle 22.5°",
        "reduced, friction angle 22.5°, worst, δ 3 %",
        "deformation only, friction angle 22.5°",
        f"full-order, friction angle {TEST[1]:g}°",
        f"reduced, friction angle {TEST[1]:g}°, best, δ 1 %",
    ]
    assert "diverged; shown as at t = 0.2 s" in told


def test_pictures_of_a_diverged_run_say_when_it_stopped():
    good, lost = motions(2)
    figure = final_shapes([Case(good), Case(replace(lost, stopped=0.12))])
    notes = [text.get_text() for text in figure.texts if "diverged" in text.get_text()]
    assert notes == ["diverged; shown as at t = 0.12 s"]


def test_a_legend_and_labels_of_long_settings_leave_the_chart_its_room(tmp_path):
    names = [
        f"history · operators engine · deploy.error_ratio={k}.25, material.yield_stress=400.0"
        for k in range(4)
    ]
    solvers = [{"solver": n, "kind": "reduced", "span_ms": 1.0, "displacement_error": 0.1} for n in names]
    figure = error_over_cost({"block": solvers}, {"block": {}})
    figure.savefig(tmp_path / "cost.png")
    assert figure.legends[0].get_window_extent().x1 <= figure.bbox.x1

    label = "nsf · |S| 1,040 · scene.design.train=[" + ",".join(map(str, range(25))) + "]"
    variants = [{"label": label, "mean": 0.01, "values": [0.01], "paper": None}]
    figure = charts.delta_per_variant(variants)
    figure.savefig(tmp_path / "delta.png")
    (panel,) = figure.axes
    (shown,) = (text.get_text() for text in panel.get_yticklabels())
    assert shown.replace("\n", " ").replace("\N{NO-BREAK SPACE}", " ").replace(", ", ",") == label
    assert not any(line.startswith(",") for line in shown.splitlines())
    assert panel.get_window_extent().width > 0.4 * figure.bbox.width


def test_error_over_time_has_a_line_a_value_in_per_cent(series):
    figure = charts.error_over_time(series, name="friction angle", unit="°")
    for panel, column in zip(figure.axes, ("delta", "displacement_error"), strict=True):
        assert len(panel.lines) == len(TEST)
        for line, (_, part) in zip(panel.lines, series.groupby("parameter"), strict=True):
            np.testing.assert_allclose(line.get_ydata(), 100 * part[column])
    assert figure.legends[0].get_title().get_text() == "friction angle [°]"


def test_a_legend_of_long_names_stays_within_the_picture(series, tmp_path):
    values = sorted(series["parameter"].unique())
    long = {value: f"E={4000.12 + value} Pa, density=8{value}.6157 kg/m³, program=2002" for value in values}
    many = [series.assign(parameter=series["parameter"].map(long) + str(k)) for k in range(3)]
    figure = charts.error_over_time(pd.concat(many))
    figure.savefig(tmp_path / "x.png")
    assert len(figure.legends[0].get_texts()) == 3 * len(values) > 4
    assert figure.legends[0].get_window_extent().x1 <= figure.bbox.x1


def test_every_axis_names_its_unit(series):
    figures = [charts.error_over_time(series), charts.reconstruction_and_rollout(series, "angle", "°")]
    for figure in figures:
        for panel in figure.axes:
            assert panel.get_xlabel().endswith("]")
            assert panel.get_ylabel().endswith("]")
    latent = charts.latent_trajectories(series)
    assert sum("[–]" in text for text in labels(latent)) == 2 + 6


def test_errors_over_decades_are_drawn_on_a_log_axis():
    t = np.linspace(0, 1, 50)
    frame = pd.DataFrame(
        {"parameter": 1.0, "t": t, "delta": 10.0 ** (-4 * t), "displacement_error": 0.1 + 0.1 * t}
    )
    wide, narrow = charts.error_over_time(frame).axes
    assert (wide.get_yscale(), narrow.get_yscale()) == ("log", "linear")


def test_reconstruction_and_rollout_are_rms_over_frames(series):
    panel = charts.reconstruction_and_rollout(series).axes[0]
    expected = [100 * np.sqrt((part["delta"] ** 2).mean()) for _, part in series.groupby("parameter")]
    np.testing.assert_allclose(panel.lines[1].get_xdata(), expected)


def test_numbers_below_logarithmic_axes_stand_apart(tmp_path):
    label = "bread · deformation_only · basis field · r 6 · modal engine · |S| 450"
    memory = {"memory_full_mib": 7.0, "memory_reduced_mib": 889.0}
    variants = [
        {"label": label, "speedup_step": 0.02, "speedup_total": 2.0, "speedup_shown": 1.0} | memory
    ] * 3
    deltas = [{"label": label, "mean": 0.002, "values": [4e-4, 0.04], "paper": None}]
    spans = {"bread": (0.0026, 0.14), "cake": (0.024, 0.24), "metal": (0.0025, 0.13)}
    panels = {
        scene: [{"solver": "nsf", "kind": "reduced", "span_ms": ms, "displacement_error": 0.1} for ms in span]
        for scene, span in spans.items()
    }
    figures = [
        charts.speedup_and_memory(variants),
        charts.delta_per_variant(deltas),
        error_over_cost(panels, {}),
    ]
    for fig in figures:
        save(fig, tmp_path, "chart")
        for panel in fig.axes:
            low, high = panel.get_xlim()
            at = zip(panel.get_xticks(), panel.get_xticklabels(), strict=True)
            boxes = [text.get_window_extent() for tick, text in at if low <= tick <= high]
            assert len(boxes) >= 2
            letters = 1.5 * LETTER * fig.dpi / 72  # two, with some leeway for what is wider
            assert all(left.x1 + letters < right.x0 for left, right in itertools.pairwise(boxes))


@pytest.mark.parametrize("span", [(2.1, 4.9), (0.2, 0.9), (3.0, 30.0), (0.7, 7e3)])
def test_a_narrow_logarithmic_axis_has_numbers(span):
    with styled():
        fig = Figure(figsize=(1.0, 1.0))
        panel = fig.subplots()
        panel.set(xscale="log", xlim=span)
        plain_ticks(panel.xaxis)
        set_apart(fig)
    assert sum(span[0] <= tick <= span[1] for tick in panel.get_xticks()) >= 2


def test_a_wide_logarithmic_axis_keeps_its_numbers():
    spans = {"bread": (0.5, 7.0), "cake": (4.5, 16.0), "sand": (0.5, 7.0)}
    panels = {
        scene: [{"solver": "nsf", "kind": "reduced", "span_ms": ms, "displacement_error": 0.1} for ms in span]
        for scene, span in spans.items()
    }
    bread = error_over_cost(panels, {}).axes[0]
    low, high = bread.get_xlim()
    assert [tick for tick in bread.get_xticks() if low <= tick <= high] == [0.5, 1.0, 2.0, 5.0]


def test_a_label_beside_a_chart_keeps_a_letter_with_its_number():
    label = "jelly_cube · nsf · mlp field · r 5 · reference engine · |S| 50"
    entry = {"label": label, "speedup_step": 4.0, "speedup_total": 1.0, "speedup_shown": 0.5}
    entry |= {"memory_full_mib": 900.0, "memory_reduced_mib": 400.0}
    (shown,) = (text.get_text() for text in charts.speedup_and_memory([entry]).axes[0].get_yticklabels())
    assert len(shown.splitlines()) == 2
    assert shown.endswith("|S|\N{NO-BREAK SPACE}50")


def test_runtime_rings_say_the_sum():
    figure = charts.runtime_breakdown({"reduced": {"p2g": 1.5, "transfer": 0.5}, "full_order": {}})
    told = [text.get_text() for panel in figure.axes for text in panel.texts]
    assert "2 ms,\nall stages" in told
    assert "not measured" in told


def test_bars_say_what_was_not_measured():
    entry = {"label": "nsf", "speedup_step": 4.0, "speedup_total": float("nan"), "speedup_shown": 2.0}
    entry |= {"memory_full_mib": 900.0, "memory_reduced_mib": 400.0}
    told = [text.get_text() for panel in charts.speedup_and_memory([entry]).axes for text in panel.texts]
    assert "not measured" in told
    assert "900" in told


def test_saved_charts_are_equal_byte_for_byte(series, tmp_path):
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        save(charts.error_over_time(series), tmp_path / folder, "x")
    for name in ("x.svg", "x.png"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()


def test_camera_axes_are_orthonormal_and_z_points_up():
    axes = Camera(azimuth=-40, elevation=25).axes
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
    assert axes[0, 2] == 0
    assert axes[1, 2] > 0


def test_final_shapes_have_a_row_a_value_and_units():
    figure = final_shapes([Case(m) for m in motions(3, particles=50)], "friction angle", "°")
    assert sum(bool(panel.images) for panel in figure.axes) == 3 * 3
    told = [text.get_text() for text in figure.texts] + labels(figure)
    assert "friction angle 32.5°, t = 0.6 s" in told
    assert any(text.endswith("[mm]") for text in told)
    assert any(text.endswith("Pa]") for text in told)


def test_material_point_shows_no_rounding():
    """Shear keeps the volume: pressure and the stresses out of plane are rounding, not a response."""
    response = point_response(config.load(["material=von_mises", "path=simple_shear"], "point"))
    assert 0 < response["pressure"].abs().max() < 1e-3
    along, plane = point_chart(response, "shear").axes
    assert {line.get_label() for line in along.lines} == {"τ xx", "τ yy", "τ xy"}
    np.testing.assert_array_equal(plane.lines[0].get_xdata(), 0.0)
    np.testing.assert_allclose(plane.lines[0].get_ydata(), response["dev_norm"], atol=1e-3)
    np.testing.assert_allclose(along.lines[-1].get_ydata(), response["tau_xy"], atol=1e-3)
    np.testing.assert_array_equal(along.lines[-1].get_xdata(), response["amplitude"])


@pytest.mark.parametrize("largest", [2.0, 1e3, 1e14])
def test_an_axis_of_errors_has_ticks_however_many_decades_it_spans(largest):
    t = np.linspace(0.0, 0.16, 50)
    frame = pd.DataFrame({"parameter": 6.0, "t": t, "delta": np.geomspace(1e-2, largest, 50)})
    (panel,) = charts.error_over_time(frame, columns=("delta",)).axes
    low, high = panel.get_ylim()
    assert high < 2 * charts.LOST  # beyond it a run is lost, by how much tells nothing
    shown = [tick for tick in panel.get_yticks() if low <= tick <= high]
    assert 3 <= len(shown) <= 12
    assert len(panel.get_xticks()) <= 7


def test_a_search_shows_its_trials_by_whole_numbers():
    table = pd.DataFrame({"trial": [0, 1, 2], "delta": [2e-3, np.nan, 1e-3], "pareto": [False, False, True]})
    panel = search_chart(table, ["delta"]).axes[0]
    np.testing.assert_allclose(panel.collections[0].get_offsets(), [[0, 0.2], [2, 0.1]])
    assert panel.get_xticks().tolist() == np.round(panel.get_xticks()).tolist()


def test_step_over_particles_has_a_line_for_each_solver():
    times = {"full order": 1.0, "full order, Δx × 2": 0.2, "full order, Δx × 3": 0.1, "modal engine": 0.5}
    panels = {"sand": {name: {1000: ms, 1_000_000: 10 * ms} for name, ms in times.items()}}
    fig = step_over_particles(panels)
    panel = fig.axes[0]
    assert [line.get_label() for line in panel.lines] == list(times)
    assert len({(line.get_color(), str(line._dash_pattern)) for line in panel.lines}) == 4
    assert [text.get_text() for text in panel.get_xticklabels()] == ["1,000", "1,000,000"]
