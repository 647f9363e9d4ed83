"""Tables: which rows survive a merge, what is averaged, and how a number is written."""

import io
import json
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from rich.console import Console
from synthetic import TEST, Made, seal, write_run

from nsf.errors import MissingRunError, SchemaError
from nsf.paths import CONF
from nsf.reporting import COLUMNS, console_table, merge_results, rivals
from nsf.reporting.rivals import beside_rivals, over_cost, side_by_side, solvers, where_rivals_win
from nsf.reporting.sources import open_sources
from nsf.reporting.tables import (
    PAPER,
    means,
    merge,
    rows_of,
    told_apart,
    variant_labels,
    without_constants,
)
from nsf.reporting.text.columns import COLUMN, COSTS, RIVALS, number, parameter_text, speedups
from nsf.results.formats import HTML, markdown_table

EARLIER, LATER = "2024-05-01T10:00:00+00:00", "2024-06-01T10:00:00+00:00"


def test_columns_are_exactly_those_of_the_design(sweep):
    expected = [
        "scene", "method", "field", "r", "engine", "sample", "integration_mean", "parameter", "split",
        "delta", "displacement_error", "stress_error", "displacement_static", "displacement_nearest",
        "displacement_interpolated", "displacement_coarse", "gamma", "step_ms_full", "step_ms_reduced",
        "step_ms_coarse", "total_ms_full", "total_ms_reduced", "total_ms_coarse", "decode_ms", "speedup_step",
        "speedup_total", "memory_full_mib", "memory_reduced_mib", "teach_seconds",
        "break_even_runs", "handed_over", "estimated_error", "true_error", "height_error",
        "run_out_error", "opening_error", "springback_error", "precision", "device", "commit",
    ]  # fmt: skip
    frame = merge_results(sweep)
    assert list(frame.columns) == expected == list(COLUMNS)
    assert len(frame) == len(sweep) * len(TEST)


@pytest.mark.parametrize("newest_first", [True, False])
def test_newest_run_wins_for_equal_variant_and_parameter(tmp_path, newest_first):
    old = write_run(tmp_path, Made(noise=0.02, created=EARLIER))
    new = write_run(tmp_path, Made(parameters=TEST[:2], splits=("test",) * 2, noise=0.001, created=LATER))
    merged = merge(open_sources([new, old] if newest_first else [old, new]))
    owner = dict(zip(merged.frame["parameter"], (source.id for source in merged.source), strict=True))
    assert owner == {TEST[0]: new.id, TEST[1]: new.id, TEST[2]: old.id, TEST[3]: old.id}
    assert {value for _, value in merged.superseded} == set(TEST[:2])


def test_the_run_asked_for_stands_for_its_variant(tmp_path):
    old = write_run(tmp_path, Made(noise=0.02, created=EARLIER))
    new = write_run(tmp_path, Made(noise=0.001, created=LATER))
    merged = merge(open_sources([new, old], first=old))
    assert {source.id for source in merged.source} == {old.id}


@pytest.mark.parametrize(
    "difference",
    [{"method": "deformation_only"}, {"sample": 50}, {"r": 5}, {"device": "cpu"}, {"engine": "modal"}],
    ids=str,
)
def test_runs_that_differ_in_the_variant_key_both_stay(tmp_path, difference):
    made = Made(created=EARLIER)
    runs = [write_run(tmp_path, m) for m in (made, replace(made, created=LATER, **difference))]
    assert len(merge_results(runs)) == 2 * len(TEST)


def test_number_of_the_device_is_no_variant(tmp_path):
    made = Made(device="cuda:0", created=EARLIER)
    runs = [write_run(tmp_path, m) for m in (made, replace(made, device="cuda:3", created=LATER))]
    assert set(merge_results(runs)["device"]) == {"cuda:3"}


def test_means_are_per_variant_and_split_and_beside_the_paper(tmp_path):
    made = Made(splits=("test", "test", "validation", "test"))
    run = write_run(tmp_path, made)
    table = means(merge(open_sources([run])))
    table, printed = table[table["field"] != PAPER].set_index("split"), table[table["field"] == PAPER]
    rows = pd.read_csv(run.path / "results.csv")
    assert table.loc["test", "delta"] == pytest.approx(rows[rows["split"] == "test"]["delta"].mean())
    assert list(table["values"]) == [3, 1]
    (paper,) = printed.to_dict("records")
    assert (paper["split"], paper["delta"], paper["sample"]) == ("test", 0.004, 150)
    assert paper["place"] == "Table 1, Sand"
    assert pd.isna(paper["speedup_total"])  # the paper prints none


@pytest.mark.parametrize("trials", [0, 10])
def test_a_training_is_timed_only_with_the_runs(tmp_path, trials):
    run = write_run(tmp_path, Made(training_seconds=77.0))
    cost = json.loads((run.path / "cost.json").read_text())
    (run.path / "cost.json").write_text(json.dumps(cost | {"trials": trials}))
    seal(run)
    (source,) = open_sources([run])
    assert source.training_seconds == (77.0 if trials else None)
    shown, _ = without_constants(means(merge([source])))
    assert ("training_seconds" in shown) == bool(trials)


def test_the_papers_figure_stands_beside_the_papers_method_only(sweep):
    table = means(merge(open_sources(sweep)))
    assert list(table.loc[table["field"] == PAPER, "method"]) == ["nsf"]
    assert set(table["method"]) == {"nsf", "deformation_only"}


def test_speedups_are_of_mean_times(tmp_path):
    """Of four runs one is slow. Of reports that do not have the time of a run the mean of ratios stays."""
    run = write_run(tmp_path, Made())
    rows = pd.read_csv(run.path / "results.csv")
    rows["step_ms_reduced"] = rows["step_ms_full"] / [100, 100, 100, 1]
    rows["speedup_step"] = rows["step_ms_full"] / rows["step_ms_reduced"]
    rows.to_csv(run.path / "results.csv", index=False)
    seal(run)
    row = means(merge(open_sources([run]))).iloc[0]
    assert row["speedup_step"] == pytest.approx(4 / 1.03)
    assert pd.isna(rows.get("total_ms_full", pd.Series([np.nan]))).all()
    assert row["speedup_total"] == pytest.approx(rows["speedup_total"].mean())


@pytest.mark.parametrize("reduced", [0.0, float("nan")])
def test_a_time_that_is_none_makes_no_speedup(reduced):
    assert speedups({"step_ms_full": 1.0, "step_ms_reduced": reduced}) == {}


def test_a_diverged_value_is_not_averaged_around(tmp_path):
    run = write_run(tmp_path, Made())
    rows = pd.read_csv(run.path / "results.csv")
    rows.loc[0, ["delta", "stress_error"]] = [float("inf"), float("nan")]
    rows.to_csv(run.path / "results.csv", index=False)
    seal(run)
    table = means(merge(open_sources([run])))
    assert table["delta"].iloc[0] == float("inf")
    assert pd.isna(table["stress_error"].iloc[0])
    assert "∞" in markdown_table(rows_of(table))


def test_tables_show_units_and_escape(sweep):
    frame = merge_results(sweep)
    frame.loc[0, "field"] = "<mlp|x>"
    rows = rows_of(frame)
    markdown, page = markdown_table(rows), HTML.get_template("tables.html").module.table(rows)
    for heading in ("δ [%]", "full-order step [ms]", "speedup, total [×]", "reduced memory [MiB]"):
        assert heading in markdown
        assert heading in page
    assert "&lt;mlp\\|x&gt;" in markdown
    assert "&lt;mlp|x&gt;" in page
    assert number(frame["delta"].iloc[0], 100) in page


def test_console_table_states_constants_once(sweep):
    stream = io.StringIO()
    Console(file=stream, width=200).print(console_table(merge_results(sweep)))
    text = stream.getvalue()
    assert "scene sand" in text
    assert "[ms]" in text  # rich would swallow it as markup
    assert text.count("sand") == 1


def test_a_setting_stays_beside_the_one_without_a_name(sweep):
    frame = merge_results(sweep).assign(setting="")
    shown, said = without_constants(frame)
    assert "setting" not in shown
    assert "setting" not in said
    named = frame.copy()
    named.loc[named.index[0], "setting"] = "deploy.on_distrust=full_order"
    assert list(without_constants(named)[0]["setting"]) == list(named["setting"])


def test_without_constants_keeps_what_varies(sweep):
    shown, said = without_constants(merge_results(sweep))
    assert {"method", "sample", "parameter", "delta"} <= set(shown)
    assert "precision" not in shown
    assert "precision fp64" in said


def test_labels_name_what_differs():
    rows = [
        dict.fromkeys(("scene", "field", "engine", "setting", "precision", "device"), "x") for _ in range(2)
    ]
    rows[0] |= {"method": "nsf", "r": 6, "sample": "150"}
    rows[1] |= {"method": "nsf", "r": 6, "sample": "50"}
    assert variant_labels(rows) == ["nsf · |S| 150", "nsf · |S| 50"]
    rows[0]["engine"] = "operators"
    rows[1]["engine"] = ""  # of before there were engines
    assert variant_labels(rows) == ["nsf · operators engine · |S| 150", "nsf · |S| 50"]


def test_an_engine_is_said_of_no_row_that_does_not_name_it(tmp_path):
    runs = [
        write_run(tmp_path, Made(engine=engine, parameters=TEST[:1], splits=("test",)))
        for engine in ("", "modal")
    ]
    frame = merge_results(runs)
    shown, said = without_constants(frame)
    assert sorted(shown["engine"]) == ["", "modal"]
    assert "modal" not in said
    shown, said = without_constants(frame[frame["engine"] == "modal"])
    assert "engine" not in shown
    assert "engine modal" in said
    shown, said = without_constants(frame[frame["engine"] == ""])
    assert "engine" not in shown
    assert "engine" not in said


def test_solvers_stand_side_by_side(tmp_path):
    made = Made(splits=("test", "test", "validation", "test"), engine="modal")
    runs = [
        write_run(tmp_path, replace(made, engine=e, noise=n))
        for e, n in (("modal", 0.01), ("operators", 0.02))
    ]
    frame = solvers(merge(open_sources(runs))).set_index("solver")
    assert list(frame.index) == ["full order", "nsf · modal engine", "nsf · operators engine"]
    rows = pd.read_csv(runs[1].path / "results.csv")
    own = frame.loc["nsf · operators engine"]
    assert own["displacement_error"] == pytest.approx(rows["displacement_error"][[0, 1, 3]].mean())
    assert own["shown_ms"] == pytest.approx(rows["total_ms_reduced"][0] + 3.0)
    assert frame.loc["full order", "total_ms"] == pytest.approx(rows["total_ms_full"][0])
    assert frame.loc["full order", "delta"] == 0.0


def test_coarse_runs_stand_with_the_solvers(tmp_path):
    run = write_run(tmp_path, Made(engine="modal", rivals=True))
    merged = merge(open_sources([run]))
    frame = solvers(merged).set_index("solver")
    assert list(frame.index) == ["full order", "full order, Δx × 2", "nsf"]
    own = frame.loc["full order, Δx × 2"]
    assert own["displacement_error"] == pytest.approx(0.2)
    assert (own["step_ms"], own["total_ms"], own["span_ms"]) == (1.0, 12.0, 0.5)  # of half as many steps
    assert frame.loc["nsf", "span_ms"] == frame.loc["nsf", "step_ms"]
    (table,) = beside_rivals(merged)
    assert table.content.headings[-4:] == [COLUMN[name].heading for name in RIVALS]
    assert table.content.body[0][-4:] == ["100", "9", "5", "20"]
    assert "sand has no run at Δx × 3: a wall is too thin." in table.note


def test_rivals_that_win_at_single_values_are_told_where_none_wins_in_the_mean(tmp_path):
    splits = ("test",) * (len(TEST) - 1) + ("validation",)
    made = [Made(engine="modal", rivals=True, scene=scene, splits=splits) for scene in ("sand", "cake")]
    merged = merge(open_sources([write_run(tmp_path / made.scene, made) for made in made]))
    frame, test = merged.frame, merged.frame["split"] == "test"
    sand, cake = (frame.index[test & (frame["scene"] == scene)] for scene in ("sand", "cake"))
    frame.loc[~test, "displacement_coarse"] = 1e-9  # a validation value is shown nowhere
    assert "At single values" not in beside_rivals(merged)[0].note
    frame.loc[sand[1], "displacement_coarse"] = 0.5 * frame.loc[sand[1], "displacement_error"]
    frame.loc[cake, "displacement_coarse"] = 1e-9  # wins in the mean, which says it
    (table,) = beside_rivals(merged)
    told = table.note.partition("At single values a rival is nearer: ")[2]
    named = parameter_text(frame.loc[sand[1], "parameter"], *merged.source[sand[1]].parameter)
    assert told.startswith(f"on sand at {named} coarse full order (")
    assert told.count(" beside ") == 1
    assert "best reduced run: on cake" in table.note


def test_single_values_are_means_over_seeds(tmp_path):
    made = [Made(engine="modal", rivals=True, seed=seed, sample=100 + seed) for seed in (0, 1)]
    made += [Made(engine="operators", rivals=True, seed=2)]
    runs = [write_run(tmp_path / str(one.seed), one) for one in made]
    merged = merge(open_sources(runs), {run.id: f"seed={run.path.parts[-4]}" for run in runs})
    frame, value = merged.frame, merged.frame["parameter"].iloc[0]
    frame.loc[:, "displacement_coarse"] = 1.0
    of = {
        one.seed: frame.index[(frame["setting"] == f"seed={one.seed}") & (frame["parameter"] == value)][0]
        for one in made
    }
    frame.loc[of[0], ["displacement_error", "displacement_coarse"]] = [0.04, 0.03]
    frame.loc[of[1], ["displacement_error", "displacement_coarse"]] = [0.08, 0.05]
    frame.loc[of[2], ["displacement_error", "displacement_coarse"]] = [0.07, 0.08]
    told = "At single values, in the mean of seeds, a rival is nearer: "
    assert told in beside_rivals(merged)[0].note
    assert "coarse full order (4 %) beside 6 %" in beside_rivals(merged)[0].note
    frame.loc[of[1], "displacement_coarse"] = float("nan")  # not measured there: no mean
    assert "coarse full order (" not in beside_rivals(merged)[0].note


def test_lines_of_rivals_are_means_over_held_out_values(tmp_path, monkeypatch):
    merged = merge(open_sources([write_run(tmp_path, Made(engine="modal", rivals=True))]))
    test = merged.frame["split"] == "test"
    merged.frame.loc[test, "displacement_nearest"] = np.linspace(0.1, 0.5, int(test.sum()))
    drawn = {}
    monkeypatch.setattr(rivals, "error_over_cost", lambda panels, free: drawn.update(free))
    monkeypatch.setattr(rivals, "save", lambda figure, folder, name: name)
    over_cost(merged, tmp_path, [])
    assert drawn["sand"][COLUMN["displacement_nearest"].title] == pytest.approx(0.3)


def test_runs_that_were_held_to_no_rival_have_no_such_table(sweep):
    assert beside_rivals(merge(open_sources(sweep))) == []


def test_a_rival_that_wins_is_told_with_its_error_and_the_reduced_runs():
    rivals = dict(zip(RIVALS, (1.0, 0.04, 0.02, float("nan")), strict=True))
    rows = [{"scene": "sand", "displacement_error": e} | rivals for e in (0.03, 0.5)]
    assert where_rivals_win(pd.DataFrame(rows)) == (
        "A rival has a smaller displacement error than the best reduced run: on sand interpolated latents "
        "(2 %) beside 3 %."
    )
    rows[0]["displacement_error"] = 0.01
    assert where_rivals_win(pd.DataFrame(rows)).startswith("No rival has a smaller")
    rows[0]["displacement_error"] = 0.0  # the full-order solver's
    assert where_rivals_win(pd.DataFrame(rows)).endswith("beside 50 %.")
    rows[0]["displacement_error"] = 0.01
    rows.append({"scene": "bread", "displacement_error": float("inf")} | rivals)
    assert where_rivals_win(pd.DataFrame(rows)).endswith(
        "on bread nothing moves (100 %), nearest training run (4 %) and interpolated latents (2 %) beside ∞."
    )
    assert where_rivals_win(pd.DataFrame(rows).assign(**dict.fromkeys(RIVALS, float("nan")))) == ""


def test_a_table_side_by_side_drops_what_older_runs_did_not_time(sweep, tmp_path):
    (table,) = side_by_side(merge(open_sources(sweep)))
    assert "step [ms]" in table.content.headings
    assert not any("decoded" in heading for heading in table.content.headings)
    run = write_run(tmp_path, Made())
    frame = pd.read_csv(run.path / "results.csv")
    frame[[name for name in COSTS if name in frame]] = float("nan")
    frame.to_csv(run.path / "results.csv", index=False)
    seal(run)
    assert side_by_side(merge(open_sources([run]))) == []


@pytest.mark.parametrize(
    ("value", "scale", "text"),
    [(0.0041234, 100, "0.412"), (0.0, 100, "0"), (float("nan"), 1, "–"), (35681.5, 1, "35,682"),
     (float("inf"), 100, "∞"), (1.6e-6, 1, "1.60e-06"), ("fp64", 1, "fp64"), (12.34, 1, "12.3")],
)  # fmt: skip
def test_number(value, scale, text):
    assert number(value, scale) == text


def test_parameter_text():
    assert parameter_text(27.5, "friction angle", "°") == "friction angle 27.5°"
    assert parameter_text(3.0, "E", "Pa") == "E 3 Pa"


def test_no_complete_run_names_the_command(tmp_path):
    run = write_run(tmp_path, Made(status="failed"))
    with pytest.raises(MissingRunError, match="nsf evaluate scene=sand"):
        merge_results([run])
    with pytest.raises(MissingRunError, match="nsf evaluate"):
        merge_results([])


def test_incomplete_runs_are_passed_over(tmp_path):
    whole = write_run(tmp_path, Made())
    running = write_run(tmp_path, Made(sample=50, status="running"))
    assert set(merge_results([running, whole])["sample"]) == {"150"}


@pytest.mark.parametrize("name", ["results.csv", "series.csv", "frames.npz", "cost.json", "summary.json"])
def test_missing_or_altered_file_is_named(tmp_path, name):
    run = write_run(tmp_path, Made(particles=20, frames=3))
    path = run.path / name
    path.write_bytes(path.read_bytes() + b" ")
    with pytest.raises(SchemaError, match=name):
        merge_results([run])
    path.unlink()
    with pytest.raises(SchemaError, match=f"{name} is missing"):
        merge_results([run])


def test_results_without_a_column_name_it(tmp_path):
    run = write_run(tmp_path, Made(particles=20, frames=3))
    pd.read_csv(run.path / "results.csv").drop(columns="gamma").to_csv(run.path / "results.csv", index=False)
    seal(run)
    with pytest.raises(SchemaError, match="gamma"):
        merge_results([run])


def test_console_table_of_one_variant_fits_a_terminal(sweep):
    """Costs are measured once a variant, so they stand in the caption."""
    frame = merge_results(sweep)
    frame = frame[frame["method"] == "nsf"].head(1)
    stream = io.StringIO()
    Console(file=stream, width=200).print(console_table(frame))
    text = stream.getvalue()
    cost = number(frame["step_ms_full"].iloc[0])
    assert f"full-order step {cost} ms" in text
    assert max(map(len, text.split("\n\n")[0].splitlines())) < 100


def test_a_cost_of_one_row_is_not_said_of_others(sweep):
    frame = merge_results(sweep)
    assert len(frame) > 1
    frame["step_ms_full"] = [8.97] + [float("nan")] * (len(frame) - 1)
    shown, said = without_constants(frame, also=COSTS)
    assert "8.97" not in said
    assert "step_ms_full" in shown
    assert "8.97 ms" in without_constants(frame.assign(step_ms_full=8.97), also=COSTS)[1]
    without = without_constants(frame.assign(step_ms_full=float("nan")), also=COSTS)
    assert "step_ms_full" not in without[0]


def test_runs_that_no_column_tells_apart_are_told_apart_by_their_keys(tmp_path):
    """Else the newer one would silently take the place of the other."""
    one, other = (write_run(tmp_path, Made(noise=noise)) for noise in (0.02, 0.001))
    baseline = write_run(tmp_path, Made(method="deformation_only", noise=0.02))
    sources = open_sources([one, other, baseline])
    told = told_apart(sources)
    assert told == {one.id: "noise=0.02", other.id: "noise=0.001"}
    merged = merge(sources, told)
    assert not merged.superseded
    assert {source.id for source in merged.source} == {one.id, other.id, baseline.id}


RANDOM = {"_target_": "nsf.sampling.RandomSampler", "size": 50, "seed": 0}
REGION = RANDOM | {"lower": [0.1] * 3, "upper": [0.9] * 3, "phases": []}
QDEIM = {"_target_": "nsf.sampling.QdeimSampler", "size": 50}
OWN = {"_target_": "nsf.sampling.own.OwnSampler", "size": 50}
GAUSS_NEWTON, TAYLOR = ({"_target_": f"nsf.dynamics.{name}"} for name in ("GaussNewton", "Taylor"))


@pytest.mark.parametrize(
    ("configs", "told"),
    [
        ([{"sampler": RANDOM}, {"sampler": QDEIM}], ["sampler=random", "sampler=qdeim"]),
        ([{"sampler": RANDOM}, {"sampler": REGION}], ["sampler=random", "sampler=region"]),
        ([{"sampler": RANDOM}, {"sampler": OWN}], ["sampler=random", "sampler=OwnSampler"]),
        (
            [{"projector": GAUSS_NEWTON | {"iterations": n}} for n in (1, 2)] + [{"projector": TAYLOR}],
            [
                "projector=gauss_newton, projector.iterations=1",
                "projector=gauss_newton, projector.iterations=2",
                "projector=taylor, projector.iterations=–",
            ],
        ),
    ],
)
def test_options_and_their_keys_tell_runs_apart(tmp_path, configs, told):
    runs = [write_run(tmp_path, Made(), **config) for config in configs]
    sources = open_sources(runs)
    found = told_apart(sources)
    assert [found[run.id] for run in runs] == told
    assert len(merge(sources, found).source) == len(runs) * len(sources[0].results)


def test_console_table_of_many_variants_fits_a_terminal():
    """No word is parted: of what differs, the table of every scene of the paper has most."""
    frame = pd.read_csv(CONF.parent / "reports/table1/results.csv")
    stream = io.StringIO()
    Console(file=stream, width=100).print(console_table(frame))
    lines = stream.getvalue().splitlines()
    assert max(map(len, lines)) <= 100
    words = {word for line in lines for word in line.split()}
    assert {"jelly_cube", "deformation_only", "reference", "δ", "speedup,", "[×]"} <= words
    assert set(map(number, frame["speedup_step"])) <= words
