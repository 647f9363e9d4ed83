"""What a report comes to: its table, laid out by what is varied, beside what the paper prints."""

import numpy as np
import pytest
from finished import job, write_report

from nsf.errors import SchemaError
from nsf.reporting import headline as module
from nsf.reporting.committed import _sources
from nsf.reporting.headline import headline
from nsf.reporting.sources import printed_delta
from nsf.reporting.summary import Report
from nsf.reporting.text.columns import LATER, RIVALS


def told(folder) -> tuple[list[list[str]], str]:
    """Cells of the table, and the sentences under it."""
    table, said = headline(Report(folder, _sources(folder)))
    headings = [heading.replace("|S|", "S") for heading in table.headings]
    return [headings, *table.body], said


def test_means_over_values_and_seeds_a_row_a_scene_and_setting(tmp_path):
    jobs = [
        job(scene, delta=0.001 * (value + seed), parameter=value, seed=str(seed), method=method)
        for scene in ("sand", "bread")
        for method in ("nsf", "deformation_only")
        for value in (1.0, 2.0)
        for seed in (0, 1)
    ]
    rows, said = told(write_report(tmp_path / "a", jobs))
    assert rows[0][:5] == ["scene", "method", "paper's δ [%]", "δ [%]", "displacement error [%]"]
    assert rows[1][:5] == ["sand", "nsf", "0.400", "0.200 ± 0.071", "2 ± 0.71"]
    assert [row[:3] for row in rows[2:]] == [
        ["sand", "deformation_only", "5"], ["bread", "nsf", "–"], ["bread", "deformation_only", "–"],
    ]  # fmt: skip
    assert said == (
        "Shown: means over held-out values and, where several were run, seeds (± their standard deviation). "
        "δ is below the paper's in 1 of 1 (nsf, basis) of the rows for which the paper prints one."
    )


def test_values_that_are_shown_each_are_judged_each(tmp_path):
    """The mean of the reduced runs is nearer than the rival's, and so is each value but one."""
    jobs = [
        job(parameter=value, delta=error / 10, **{"scene.design.test": "[41, 55]"})
        | {"displacement_coarse": 0.15}
        for value, error in ((41.0, 0.01), (55.0, 0.25))
    ]
    assert (
        "on sand at 55 coarse full order (15 %) beside 25 %." in told(write_report(tmp_path / "a", jobs))[1]
    )


def test_what_a_mean_hides_stands_beside_it(tmp_path):
    """A still body has a δ of δ over the displacement error; frames are decoded beside a run."""
    costs = {
        "total_ms_full": 60.0,
        "total_ms_reduced": 2.0,
        "decode_ms": 10.0,
    }
    rivals = {"displacement_interpolated": 0.3}
    jobs = [
        job(delta=0.001 * value, parameter=value)
        | {"displacement_error": off, "handed_over": share, "break_even_runs": 5.0 + value, **costs, **rivals}
        for value, off, share in ((1.0, 0.02, 0.0), (2.0, 0.08, 0.5))
    ]
    rows, said = told(write_report(tmp_path / "a", jobs))
    assert "means over held-out values, of one seed" in said
    shown = dict(zip(*rows, strict=True))
    assert float(shown["δ if nothing moves [%]"]) == pytest.approx(100 * (0.001 / 0.02 + 0.002 / 0.08) / 2)
    assert (shown["displacement error [%]"], shown["its largest [%]"]) == ("5", "8")
    assert (shown["interpolated latents [%]"], shown["runs until it pays"]) == ("30", "6.50")
    assert (shown["speedup, frames decoded [×]"], shown["handed on [%]"]) == ("5", "25")
    own = {"handed_over": 0.0, "break_even_runs": np.inf, "split": "validation"}
    jobs = [job(parameter=value) | own for value in (1.0, 2.0)]
    rows, said = told(write_report(tmp_path / "b", jobs))
    assert "handed on [%]" not in rows[0]
    assert "means over validation values" in said
    shown = dict(zip(*rows, strict=True))
    assert (shown["runs until it pays"], shown["δ if nothing moves [%]"]) == ("∞", "10")
    lost = {"parameter": 2.0, "displacement_error": np.inf}
    jobs = [job("bread"), job("bread", parameter=2.0), job(parameter=1.0), job(delta=np.inf) | lost]
    rows, _ = told(write_report(tmp_path / "d", jobs))
    still = rows[0].index("δ if nothing moves [%]")
    assert [row[still] for row in rows[1:3]] == ["10", "–"]  # not that of the run that is not lost
    jobs = [job(delta=np.inf)]  # one run a row, and it diverged
    rows, _ = told(write_report(tmp_path / "c", jobs))
    assert "its largest [%]" not in rows[0]
    assert dict(zip(*rows, strict=True))["displacement error [%]"] == "∞"


def test_training_values_count_only_where_there_are_no_others(tmp_path):
    jobs = [job(delta=0.001), job(delta=0.5, parameter=3.0) | {"split": "train"}]
    assert told(write_report(tmp_path / "a", jobs))[0][1][2] == "0.100"
    jobs[0]["split"] = "train"
    assert told(write_report(tmp_path / "b", jobs))[0][1][2] == "25.1"


def test_the_paper_is_shown_at_its_own_number_of_particles_and_coordinates(tmp_path):
    jobs = [job(**{"sampler.size": size}) for size in ("50", "150")] + [job(latent_dim="4")]
    report = Report(write_report(tmp_path / "a", jobs), _sources(tmp_path / "a"))
    np.testing.assert_array_equal(report.rows["paper"], [np.nan, 0.004, np.nan])


def test_the_paper_is_shown_beside_the_one_number_of_particles_that_a_scene_has(tmp_path):
    jobs = [job(parameter=value, **{"sampler.size": "40"}) for value in (1.0, 2.0)]
    report = Report(write_report(tmp_path / "a", jobs), _sources(tmp_path / "a"))
    np.testing.assert_array_equal(report.rows["paper"], [0.004, 0.004])


@pytest.mark.parametrize(
    ("entry", "expected"),
    [
        ({"sampler.size": "50"}, [0.002, np.nan, np.nan]),
        ({"parameter": "44", "deploy.on_distrust": "null"}, [np.nan, 0.002, np.nan]),
        ({"parameter": "44"}, [np.nan, 0.002, 0.002]),
        ({"scene": "bread"}, [np.nan, np.nan, np.nan]),
    ],
)
def test_what_is_printed_of_single_jobs_takes_the_place_of_the_scenes(tmp_path, entry, expected):
    jobs = [
        job(**{"sampler.size": "50"}),
        job(parameter=44.0),
        job(parameter=44.0, **{"deploy.on_distrust": "full_order"}),
    ]
    write_report(tmp_path / "a", jobs, printed=[entry | {"delta": 0.002}])
    np.testing.assert_array_equal(Report(tmp_path / "a", _sources(tmp_path / "a")).rows["paper"], expected)


def test_a_sweep_of_numbers_is_condensed_with_scenes_across(tmp_path):
    jobs = [
        job(scene, delta=0.001 * int(r), stress=0.1, latent_dim=r)
        for scene in ("sand", "bread")
        for r in ("10", "2", "3", "4", "5", "6", "8", "12")
    ]
    rows, said = told(write_report(tmp_path / "a", jobs))
    assert rows[0] == ["r", "sand", "sand, the paper", "bread"]
    assert [row[0] for row in rows[1:]] == ["2", "3", "4", "5", "6", "8", "10", "12"]
    assert rows[1] == ["2", "0.200 (10)", "–", "0.200 (10)"]
    assert rows[5][2] == "0.400"
    assert "Smallest δ: 0.200 % on sand (r 2); 0.200 % on bread (r 2)." in said


def test_more_scenes_than_settings_put_the_settings_across(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "MANY", 5)
    jobs = [job(scene, method=m) for scene in ("a", "b", "sand") for m in ("nsf", "deformation_only")]
    rows, _ = told(write_report(tmp_path / "a", jobs))
    assert rows[0] == ["scene", "nsf", "nsf, the paper", "deformation_only", "deformation_only, the paper"]
    assert [row[0] for row in rows[1:]] == ["a", "b", "sand"]
    assert (rows[1][2], rows[3][2]) == ("–", "0.400")


def test_very_many_settings_have_the_number_down_and_the_rest_across(tmp_path):
    sizes = [str(10 * k) for k in range(1, 10)]
    jobs = [job(sampler=s, **{"sampler.size": size}) for s in ("random", "cubature") for size in sizes]
    jobs.append(job("bread", sampler="random", **{"sampler.size": "15"}))
    rows, said = told(write_report(tmp_path / "a", jobs))
    assert rows[0] == ["S", "sand · random", "sand · cubature", "bread · random"]
    assert [row[0] for row in rows[1:4]] == ["10", "15", "20"]
    # One integration particle of two, as γ r / 3 = 2: where samples are compared, N stands beside δ.
    assert rows[2] == ["15", "", "", "0.100 (2, 50)"]
    assert "in brackets the stress error [%], and N in % of all particles" in said


def test_a_setting_that_no_key_changes_has_a_name(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "MANY", 3)
    plain = [job(scene) for scene in ("a", "b", "sand")]
    jobs = [*plain, *(job(scene, sampler="cells") for scene in ("a", "b", "sand"))]
    rows, said = told(write_report(tmp_path / "a", jobs))
    own = "as the scene has it"
    assert rows[0] == ["scene", own, f"{own}, the paper", "cells", "cells, the paper"]
    assert "on a (as the scene has it)" in said


def test_seeds_alone_show_their_scatter(tmp_path):
    jobs = [job(delta=0.001 * k, parameter=v, seed=str(k)) for k in (1, 2, 6) for v in (1.0, 2.0)]
    jobs += [job(delta=0.004, **{"sampler.seed": k}) for k in ("1", "2")]
    rows, _ = told(write_report(tmp_path / "a", jobs))
    assert rows[1:] == [
        ["sand", "seed", "3", "0.300 ± 0.26", "0.100", "0.600", "0.400"],
        ["sand", "sampler.seed", "2", "0.400 ± 0", "0.400", "0.400", "0.400"],
    ]


def test_settings_of_unlike_numbers_of_seeds_say_how_many(tmp_path):
    jobs = [job(seed=str(k), **{"field.beta": "8"}) for k in (0, 1)] + [job(seed="0", **{"field.beta": "16"})]
    rows, _ = told(write_report(tmp_path / "a", jobs))
    at = rows[0].index("seeds")
    assert [row[at] for row in rows[1:]] == ["2", "1"]


def test_a_sample_whose_size_follows_from_its_seed_is_beside_the_papers(tmp_path):
    jobs = [job(seed=str(k)) | {"sample": 40 + k} for k in range(2)]
    rows, _ = told(write_report(tmp_path / "a", jobs))
    assert dict(zip(*rows, strict=True))["paper's δ [%]"] == "0.400"


def test_what_follows_from_a_seed_and_what_is_a_column_are_no_settings(tmp_path):
    jobs = [
        job("cake", seed=str(k), engine=e, device="cpu", **{"sampler.size": str(40 + k)}) | {"engine": e}
        for k in range(3)
        for e in ("modal", "operators")
    ]
    for row in jobs:
        del row["keys"]["sampler.size"]
    rows, _ = told(write_report(tmp_path / "a", jobs))
    assert rows[0][:3] == ["scene", "engine", "δ [%]"]
    assert [row[1] for row in rows[1:]] == ["modal", "operators"]


def test_engines_are_settings_and_reports_from_before_them_have_none(tmp_path):
    jobs = [job(delta=0.001 * k, engine=e) | {"engine": e} for k, e in ((1, "modal"), (2, "operators"))]
    rows, _ = told(write_report(tmp_path / "a", jobs))
    assert rows[0][:2] == ["scene", "engine"]
    assert [row[1] for row in rows[1:]] == ["modal", "operators"]
    older = [{name: value for name, value in row.items() if name not in LATER} for row in jobs[:1]]
    rows, _ = told(write_report(tmp_path / "b", older))
    assert "engine" not in rows[0]


def test_where_a_rival_wins_is_said(tmp_path):
    rivals = {name: 0.5 for name in RIVALS} | {"displacement_coarse": 0.005}
    _, said = told(write_report(tmp_path / "a", [job() | rivals]))
    assert "than the best reduced run: on sand coarse full order (0.500 %) beside 1 %." in said
    older = {name: value for name, value in job().items() if name not in LATER}
    _, said = told(write_report(tmp_path / "b", [older]))
    assert "rival" not in said


def test_a_cell_says_how_many_of_its_runs_diverged(tmp_path):
    jobs = [
        job(scene, delta=np.inf if value == 2.0 and k == 3 else 0.001, parameter=value, method=f"m{k}")
        for scene in ("sand", "bread", "cake", "metal", "drop", "jelly_cube")
        for value in (1.0, 2.0)
        for k in range(5)
    ]
    rows, _ = told(write_report(tmp_path / "a", jobs))
    assert [row[rows[0].index("m3")] for row in rows[1:]] == ["1 of 2 diverged"] * 6


def test_values_that_the_jobs_name_count_one_by_one(tmp_path):
    jobs = [job(parameter=v, **{"scene.design.test": "[41,44]"}) for v in (44.0, 41.0)]
    rows, said = told(write_report(tmp_path / "a", jobs))
    assert [row[:2] for row in rows] == [["scene", "parameter"], ["sand", "41"], ["sand", "44"]]
    assert "each held-out value by itself" in said


def test_values_that_jobs_of_several_seeds_name_are_averaged(tmp_path):
    jobs = [
        job(parameter=value, seed=seed, **{"scene.design.test": "[41,44]", "field": field})
        for value in (41.0, 44.0)
        for seed in ("0", "1")
        for field in ("basis", "mlp")
    ]
    rows, said = told(write_report(tmp_path / "a", jobs))
    assert [row[:2] for row in rows] == [["scene", "field"], ["sand", "basis"], ["sand", "mlp"]]
    assert "by itself" not in said


def test_of_training_runs_their_number_is_told_and_of_other_long_lists_the_ends(tmp_path):
    lists = [f"[{','.join(map(str, range(count)))}]" for count in (8, 12)]
    for key, expected in (
        ("design.train", ["8", "12"]),
        ("own", ["[0 to 7, 8 values]", "[0 to 11, 12 values]"]),
    ):
        rows, _ = told(write_report(tmp_path / key, [job(**{f"scene.{key}": one}) for one in lists]))
        assert [row[1] for row in rows[1:]] == expected


@pytest.mark.filterwarnings("error")
def test_a_number_that_one_job_does_not_name_is_left_open(tmp_path):
    rows, said = told(write_report(tmp_path / "a", [job(), job(**{"scene.design.train": "[1,2]"})]))
    assert [row[1] for row in rows[1:]] == ["–", "2"]
    assert f" Where a job does not set {rows[0][1]}, or sets null, a cell has –." in said
    rows, said = told(write_report(tmp_path / "b", [job(sampler="random"), job()]))
    assert rows[0][1] == "sampler"
    assert " Where a job does not set sampler, or sets null, a cell has –." in said
    rows, said = told(write_report(tmp_path / "c", [job(sampler="random"), job(sampler="cells")]))
    assert rows[0][1] == "sampler"
    assert "does not set" not in said


def test_speedups_are_of_mean_times(tmp_path):
    """Of two runs, one a hundred times and one twice as fast, the mean run is 3.9 times as fast."""
    slow, fast = ({"step_ms_full": 1.0, "step_ms_reduced": ms, "speedup_step": 1 / ms} for ms in (0.5, 0.01))
    jobs = [job(parameter=1.0) | slow, job(parameter=2.0) | fast]
    rows, _ = told(write_report(tmp_path / "a", jobs))
    shown = dict(zip(*rows, strict=True))
    assert float(shown["speedup, step [×]"]) == pytest.approx(2 / 0.51, rel=1e-2)


def test_a_still_body_that_is_nearer_than_the_paper_is_named(tmp_path):
    """δ of one that never moves is δ over the displacement error; the paper prints 0.4 % of sand."""
    for name, errors, named in (("a", (0.5, 0.4), True), ("b", (0.5, 0.2), False)):
        jobs = [job(delta=0.001, sampler=str(off)) | {"displacement_error": off} for off in errors]
        _, said = told(write_report(tmp_path / name, jobs))
        assert ("A body that never moves has a smaller δ than the paper's on sand." in said) == named


def test_numbers_of_particles_of_one_scene_are_scenes_of_their_own(tmp_path):
    jobs = [job(**{"scene.bodies.column.particles": size}) for size in ("1000", "100000")]
    rows, _ = told(write_report(tmp_path / "a", jobs))
    assert [row[0] for row in rows] == ["scene", "sand · 1,000 particles", "sand · 100,000 particles"]


def test_changes_are_named_by_the_last_part_of_their_keys(tmp_path):
    changes = ("null", "{scene.bodies.slice.weakness.perturbation:0.08,a.b:2}")
    rows, _ = told(write_report(tmp_path / "a", [job(**{"deploy.changes": c}) for c in changes]))
    assert [row[1] for row in rows] == ["changes", "–", "perturbation 0.08, b 2"]


def test_small_runs_are_not_held_to_the_paper(tmp_path):
    folder = write_report(tmp_path / "a", [job()])
    sources = _sources(folder)
    sources["runs"]["run0"]["scale"] = "small"
    _, said = headline(Report(folder, sources))
    assert "these runs are of small scale" in said
    assert "below the paper's" not in said


def test_a_setting_of_an_older_report_tells_rows_apart(tmp_path):
    """One whose runs have no keys, but whose results.csv has a column for what no other tells."""
    jobs = [job() | {"setting": f"seed={k}", "delta": 0.001 * k} for k in (1, 2)]
    folder = write_report(tmp_path / "a", jobs)
    sources = _sources(folder)
    for run in sources["runs"].values():
        del run["keys"]
    table, _ = headline(Report(folder, sources))
    assert table.body[0][:4] == ["sand", "seed=1", "0.400", "0.100"]


def test_rows_that_are_not_those_of_the_sources_are_refused(tmp_path):
    folder = write_report(tmp_path / "a", [job(), job("bread")])
    report = Report(folder, _sources(folder))
    lines = (folder / "results.csv").read_text().splitlines()
    (folder / "results.csv").write_text("\n".join(lines[:-1]))
    with pytest.raises(SchemaError, match=r"has not the 2 rows .* build the report again"):
        headline(report)
    (folder / "results.csv").unlink()
    with pytest.raises(SchemaError, match="has not the 2 rows"):
        headline(report)


def test_what_the_paper_prints_of_a_job_is_found_by_its_keys():
    entries = [
        {"scene": "metal", "sampler.size": "20", "delta": 0.005},
        {"deploy.changes": "null", "delta": 0.012},
    ]
    metal = {"scene": "metal", "sampler.size": "20", "sampler": "random"}
    assert printed_delta(entries, metal) == 0.005
    assert printed_delta(entries, {"scene": "bread"}) == 0.012
    assert np.isnan(printed_delta(entries, {"scene": "bread", "deploy.changes": "{a:1}"}))
