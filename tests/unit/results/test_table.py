"""The long table: read, asked, named and averaged, against cases made by hand."""

import math

import pandas as pd
import pytest
import rich.console
from made import Made, frame

from nsf.errors import ConfigError, MissingRunError, SchemaError
from nsf.results import table
from nsf.results.averages import DEVIATION, SAID_ONCE, constants, means, where_rivals_win
from nsf.results.columns import BASELINE, COLUMNS, number
from nsf.results.formats import Rows, TerminalTable


def rows(*runs: Made, **columns) -> pd.DataFrame:
    return table.labelled(table.complete(frame(*runs).assign(**columns), "here"))


def test_a_mean_is_over_cases_and_a_deviation_over_seeds():
    averages = means(rows(Made((0.01, 0.03)), Made((0.03, 0.05), seed=1)))
    assert len(averages) == 1
    row = averages.iloc[0]
    assert row["delta"] == pytest.approx(0.03)
    assert row[f"delta{DEVIATION}"] == pytest.approx(0.02 / math.sqrt(2))  # of 0.02 and 0.04
    assert (row["cases"], row["displacement_worst"]) == (4, 0.5)


def test_gamma_is_the_papers():
    cake = means(rows(Made((0.01,), cases=("angle=14°",)), particles=200_000, r=6)).iloc[0]
    assert cake["gamma"] == 1e5  # 3 · 200,000 / 6, where the paper prints 1e6


def test_speedups_are_of_mean_times_and_decoding_counts():
    slow = frame(Made((0.01,), cases=("friction_angle=26°",))).assign(step_ms=12.0, case="friction_angle=28°")
    both = pd.concat([frame(Made((0.01,), cases=("friction_angle=26°",))), slow])
    row = means(table.labelled(table.complete(both, "here"))).iloc[0]
    assert row["speedup_step"] == pytest.approx(6.0 / 6.75)
    assert row["speedup_decoded"] == pytest.approx(60.0 / 20.0)


def test_a_run_that_diverged_makes_the_mean_infinite_and_a_missing_one_leaves_it_empty():
    assert means(rows(Made((0.01, math.inf))))["delta"].iloc[0] == math.inf
    assert math.isnan(means(rows(Made((0.01, math.nan))))["delta"].iloc[0])


def test_rivals_as_delta_take_the_ratio_of_both_errors():
    shown = rows(Made((0.01, 0.02)))
    assert shown["delta_static"].tolist() == pytest.approx([0.1, 0.1])
    assert shown["delta_interpolated"].tolist() == pytest.approx([0.005, 0.005])


def test_variants_are_named_by_what_differs():
    shown = rows(Made(), Made(stress="deformation", affine="none"), Made(model="recurrence"))
    assert sorted(shown["variant"].unique()) == [BASELINE, "projected", "recurrence"]
    settings = ["sampler=random; sampler.size=12"] * 2 + ["sampler=cubature; sampler.size=12"] * 2
    shown = rows(Made(), Made(r=8), setting=settings)
    assert sorted(shown["variant"].unique()) == ["cubature", "random"]
    assert shown["sampler.size"].tolist() == [12] * 4


def test_programs_beyond_what_was_taught_are_a_row_of_their_own():
    cases, models = ("E=5 Pa, program=0", "E=6 Pa, program=1"), ("projected", "recurrence")
    made = frame(*(Made((0.01, 9.0), cases, model=model) for model in models))
    shown = table.labelled(table.complete(made, "here").assign(beyond=[0, 0, 0, 1]))
    averages = means(shown).set_index("variant")
    assert averages["cases"].tolist() == [1] * 4
    for model in models:
        assert averages["delta"][model] == 0.01
        assert averages["delta"][model + table.BEYOND] == 9.0


def test_a_body_has_its_material_or_size_where_a_scene_has_several():
    assert set(rows(Made(), Made(particles=1_000_000))["body"]) == {
        "sand · 3,000 particles", "sand · 1,000,000 particles",
    }  # fmt: skip


def test_what_never_changes_is_said_once():
    shown = rows(Made(), Made(model="recurrence"))
    assert constants(shown, ("field", "model", "r")) == {"field": "basis", "r": "6"}
    baseline = rows(Made(), Made(stress="deformation", affine="none"))
    assert {"model", "stress", "affine"}.isdisjoint(constants(baseline, SAID_ONCE))
    assert constants(rows(Made()), SAID_ONCE)["model"] == "projected"


def test_a_table_survives_its_file(tmp_path):
    whole = table.complete(frame(Made((1 / 3, math.inf))), "here")
    table.write(whole, tmp_path / "results.csv")
    pd.testing.assert_frame_equal(table.read(tmp_path / "results.csv"), whole, check_exact=True)


def test_a_query_names_what_there_is():
    whole = table.complete(frame(Made(), Made(model="recurrence")), "here")
    assert len(table.query(whole, model="recurrence")) == 2
    with pytest.raises(ConfigError, match="no row has model=full; there are projected, recurrence"):
        table.query(whole, model="full")
    with pytest.raises(ConfigError, match="no column engine; there are report"):
        table.query(whole, engine="modal")


def test_a_file_that_is_no_table_is_refused(tmp_path):
    with pytest.raises(MissingRunError, match="nsf report"):
        table.read(tmp_path / "results.csv")
    (tmp_path / "results.csv").write_text("scene,method\nsand,nsf\n")
    with pytest.raises(SchemaError, match="lacks the columns model, case, split, delta; run `nsf evaluate`"):
        table.read(tmp_path / "results.csv")
    frame(Made()).assign(delta="near").to_csv(tmp_path / "results.csv")
    with pytest.raises(SchemaError, match="delta holds text"):
        table.read(tmp_path / "results.csv")


def test_where_rivals_win():
    won = where_rivals_win(means(rows(Made((0.01, 0.01)))))
    assert won == (
        "A rival has a smaller displacement error than the best model: on sand interpolated latents (5 %) "
        "beside 10 %."
    )
    assert where_rivals_win(means(rows(Made((0.001, 0.001))))).startswith("No rival")


def test_every_column_has_a_meaning_and_measured_ones_a_unit():
    pure = {"break_even_runs"}
    assert all(column.meaning for column in COLUMNS.values())
    assert all(column.unit for column in COLUMNS.values() if column.measured and column.name not in pure)


@pytest.mark.parametrize(
    ("value", "shown"),
    [(0.00123, "0.00123"), (12.34, "12.3"), (1234.5, "1,234"), (math.inf, "∞"), (math.nan, "–"), (3.0, "3")],
)
def test_numbers_have_three_digits(value, shown):
    assert number(value) == shown


def test_a_narrow_terminal_has_fewer_columns_and_no_broken_number():
    rows = Rows(
        ["name", "displacement error [%]", "step [ms]"],
        [["a long name", "8.99e-04 ± 0.0004", "1.25"]],
        [False, True, True],
    )
    console = rich.console.Console(width=32, color_system=None)
    with console.capture() as capture:
        console.print(TerminalTable(rows))
    shown = capture.get()
    assert "8.99e-04 ± 0.0004" in shown
    assert "Hidden for want of width: step" in shown
    assert max(map(len, shown.splitlines())) <= 32
