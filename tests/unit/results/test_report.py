"""A report of runs: its page and table, what it refuses, and when it stands as it is."""

import json
import math
import re

import numpy as np
import pandas as pd
import pytest
from made import Made, rewrite, seal, write_run

from nsf.errors import ConfigError, MissingRunError, SchemaError
from nsf.results import pictures, table
from nsf.results.averages import interval, means
from nsf.results.columns import number
from nsf.results.question import Question, unchanged
from nsf.results.report import build_report
from nsf.results.sources import open_sources
from nsf.results.verdict import verdict

ASKED = Question(
    "trial", "Sand & <friends>", "How far?", "Table 1: 0.4 %.", missing=["seed=2: not run"], plots=["delta"]
)
SCRIPT = "</title><script>alert(1)</script> | [x](javascript:alert(1)) $x^2$ \\input{/etc/passwd}"


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    root = tmp_path_factory.mktemp("runs")
    models = (Made(), Made((0.02, 0.04), seed=1), Made((0.1, 0.2), stress="deformation", affine="none"))
    return [write_run(root, made) for made in models]


@pytest.fixture(scope="module")
def report(runs, tmp_path_factory):
    folder = tmp_path_factory.mktemp("reports") / "trial"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pictures, "_MANY", 0)  # a strip alone of each variant
        build_report(runs, folder, ASKED)
    return folder


@pytest.fixture
def text_alone(monkeypatch):
    """Bodies and charts take seconds to draw, and some tests are about the rest."""
    monkeypatch.setattr(pictures, "sections", lambda *_: [])
    monkeypatch.setattr("nsf.results.report.figures", lambda *_: [])


def test_the_page_has_question_results_cases_and_origin(report):
    text = (report / "index.md").read_text()
    marks = [
        "How far?", "Table 1: 0.4 %.", "seed=2: not run", "## Results",
        "deformation only (baseline) | 2", "projected | 4", "## Each case", "## Charts",
        "strip.png)", "## Where the numbers come from", "1f2e3d4c5b6a",
    ]  # fmt: skip
    places = [text.find(mark) for mark in marks]
    assert -1 not in places, dict(zip(marks, places, strict=True))
    assert places == sorted(places)
    assert "&lt;friends&gt;" in (report / "index.html").read_text()
    assert "\\begin{tabular}" in (report / "results.tex").read_text()


def test_a_page_of_one_model_begins_with_its_answers(report, runs, tmp_path, text_alone):
    build_report(runs[:1], tmp_path / "one", Question("one", "T"))
    page = (tmp_path / "one/index.html").read_text()
    frame = table.labelled(table.read(tmp_path / "one/results.csv"))
    (mean,) = means(frame)["displacement_error"]
    answers = dict(verdict(frame))
    assert answers["error"].startswith(f"{number(mean, 100)} % of the displacement")
    assert page.index(answers["error"]) < page.index("<details>") < page.index("Each case")
    assert not verdict(table.labelled(table.read(report / "results.csv")))


def test_a_bound_says_in_how_many_runs_it_holds(runs):
    frame = table.labelled(open_sources(runs[:1])[0].rows.assign(setting=""))
    errors = frame["displacement_error"]
    bounded = frame.assign(error_bound=[errors.iloc[0] * 1.1, errors.iloc[1] * 0.9], flag="green")
    said = dict(verdict(bounded))["error bound"]
    assert "held by 1 of 2 runs; 2 green" in said


def test_the_table_names_the_run_of_each_row(report, runs):
    frame = table.read(report / "results.csv")
    assert set(frame["run"]) == {run.id for run in runs}
    assert frame["report"].unique().tolist() == ["trial"]
    assert frame[frame["stress"] == "field"]["paper_delta"].tolist() == [0.004] * 4
    assert frame[frame["stress"] == "deformation"]["paper_delta"].isna().all()


def test_files_and_pictures_have_their_hashes_and_runs(report, runs):
    content = json.loads((report / "sources.json").read_text())
    assert set(content["files"]) == {path.name for path in report.iterdir()} - {"sources.json"}
    assert set(content["runs"]) == {run.id for run in runs}
    assert content["pictures"]["projected-strip.png"]["runs"] == sorted({runs[0].id, runs[2].id})


def test_the_worst_case_is_the_worst_in_displacement(runs):
    source = open_sources(runs[:1])[0]
    rows = table.labelled(source.rows.assign(run=source.id, setting="", paper_delta=math.nan))
    rows = rows.assign(displacement_error=[0.3, 0.1])  # δ ranks them the other way round
    shown = pictures.cases(rows, rows.iloc[:0], {source.id: source}, 2)
    assert {case.place: case.error for case in shown} == {"worst": 0.3, "best": 0.1}


def test_a_report_stands_as_it_is_until_something_changes(runs, report, tmp_path, text_alone):
    assert unchanged(report, runs, ASKED) == report / "index.html"
    assert unchanged(report, runs[:2], ASKED) is None
    build_report(runs, tmp_path / "trial", ASKED)
    assert unchanged(tmp_path / "trial", runs, ASKED) is not None
    (tmp_path / "trial/index.md").write_text("other")
    assert unchanged(tmp_path / "trial", runs, ASKED) is None


def test_the_newest_run_counts(tmp_path, text_alone):
    old = write_run(tmp_path, Made((0.5, 0.5)), code=1)
    new = write_run(tmp_path, Made((0.1, 0.1), created="2026-11-02T10:00:00+00:00"), code=2)
    question = Question("trial", "T", keys={old.id: {}, new.id: {}})
    build_report([old, new], tmp_path / "r", question)
    assert table.read(tmp_path / "r/results.csv")["delta"].tolist() == [0.1, 0.1]
    build_report([old, new], tmp_path / "r", question, first=old)
    assert table.read(tmp_path / "r/results.csv")["delta"].tolist() == [0.5, 0.5]


def test_what_jobs_vary_is_their_setting(tmp_path, text_alone):
    some = [write_run(tmp_path, Made((0.1 * k, 0.2)), code=k) for k in (1, 2)]
    keys = {
        run.id: {"scene": "sand", "sampler": "random", "sampler.size": f"{k}2"} for k, run in enumerate(some)
    }
    build_report(some, tmp_path / "r", Question("trial", "T", keys=keys))
    assert set(table.read(tmp_path / "r/results.csv")["setting"]) == {"sampler.size=02", "sampler.size=12"}


def test_the_papers_figure_of_single_jobs(tmp_path, text_alone):
    run = write_run(tmp_path, Made())
    printed = [{"scene": "sand", "parameter": "30", "delta": 0.018}]
    build_report([run], tmp_path / "r", Question("trial", "T", keys={run.id: {}}, printed=printed))
    assert table.read(tmp_path / "r/results.csv")["paper_delta"].fillna(0).tolist() == [0.0, 0.018]


def test_an_altered_file_is_refused(tmp_path, text_alone):
    run = write_run(tmp_path, Made())
    rows = pd.read_csv(run.path / "results.csv")
    rows.assign(delta=0.0).to_csv(run.path / "results.csv", index=False)
    with pytest.raises(SchemaError, match="delete the run's folder and run `nsf evaluate` again"):
        build_report([run], tmp_path / "r", ASKED)
    assert not (tmp_path / "r").exists()
    (run.path / "results.csv").unlink()
    with pytest.raises(SchemaError, match="is missing; delete the run's folder"):
        build_report([run], tmp_path / "r", ASKED)


def test_a_run_of_another_version_is_refused(tmp_path, text_alone):
    run = write_run(tmp_path, Made())
    rows = pd.read_csv(run.path / "results.csv")
    rows.drop(columns=["case", "model"]).to_csv(run.path / "results.csv", index=False)
    seal(run)
    with pytest.raises(SchemaError, match="another version wrote it; delete the run folder"):
        build_report([run], tmp_path / "r", ASKED)


def test_no_complete_run_is_refused(tmp_path):
    run = write_run(tmp_path, Made())
    rewrite(run, status="failed")
    with pytest.raises(MissingRunError, match="none of the 1 evaluate runs is complete; run `nsf evaluate"):
        build_report([run], tmp_path / "r", ASKED)


def test_an_unknown_chart_and_a_foreign_folder_are_refused(runs, tmp_path):
    with pytest.raises(ConfigError, match="plots=pie is no chart; choose of programs, delta"):
        build_report(runs, tmp_path / "r", Question("trial", "T", plots=["pie"]))
    (tmp_path / "r").mkdir()
    (tmp_path / "r/thesis.tex").write_text("mine")
    with pytest.raises(ConfigError, match="is not a report"):
        build_report(runs, tmp_path / "r", ASKED)


def test_titles_are_no_markup(tmp_path, text_alone):
    run = write_run(tmp_path, Made())
    build_report([run], tmp_path / "r", Question("trial", SCRIPT, SCRIPT))
    page, text = ((tmp_path / "r" / name).read_text() for name in ("index.html", "index.md"))
    assert "<script>alert(1)" not in page + text
    assert "[x](javascript" not in text
    assert "\\input{/etc" not in (tmp_path / "r/results.tex").read_text()


def test_an_interval_is_of_seeds_and_cases_drawn_anew():
    assert interval(pd.DataFrame([[0.01, 0.01], [0.01, 0.01]]).to_numpy()) == "1 to 1"
    assert interval(pd.DataFrame([[0.01, 0.02]]).to_numpy()) == ""


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("summary.json", ""),
        ("summary.json", "[]"),
        ("summary.json", "[" * 100_000),
        ("summary.json", '{"paper": {"nsf": {"delta": "abc"}}}'),
        ("summary.json", '{"paper": 5}'),
        ("summary.json", '{"scale": {"a": NaN}}'),
        ("cost.json", '{"breakdown": {"reduced": {"p2g": "abc"}}}'),
        ("cost.json", "null"),
        ("results.csv", ""),
        ("results.csv", "scene,model,case,split,delta\n"),
        ("results.csv", "scene,model,case,split,delta,memory_full_mib\nsand,projected,a=1,test,0.1,abc\n"),
        ("results.csv", "scene,model,case,split,delta\nsand,projected,a=1,test,0.1,1\n"),
        ("series.csv", "case,split,frame,t,delta,displacement_error,stress_error\na=1,test,0,abc,0,0,0\n"),
        (
            "series.csv",
            "case,split,frame,t,delta,displacement_error,stress_error,xhat_2\na=1,test,0,0,0,0,0,1\n",
        ),
    ],
)
def test_a_forged_file_is_refused(tmp_path, text_alone, name, content):
    run = write_run(tmp_path / "runs", Made())
    (run.path / name).write_bytes(content.encode())
    seal(run)
    with pytest.raises(SchemaError, match=rf"{re.escape(name)}.*evaluate.* again|write it again"):
        build_report([run], tmp_path / "reports", ASKED)


def test_a_forged_table_of_more_points_is_refused(tmp_path, text_alone):
    run = write_run(tmp_path / "runs", Made())
    (run.path / "superresolution.csv").write_text("case,displacement_error\na=1,abc\n")
    seal(run, "superresolution.csv")
    with pytest.raises(SchemaError, match=r"superresolution\.csv: displacement_error holds text"):
        build_report([run], tmp_path / "reports", Question("trial", "T", fine={run.id: run}))


@pytest.mark.parametrize(
    "change", [{"x_full": np.zeros((2, 4, 3))}, {"role": None}, {"t": np.full(4, np.inf)}]
)
def test_forged_frames_are_refused(tmp_path, change):
    run = write_run(tmp_path / "runs", Made())
    with np.load(run.path / "frames.npz") as stored:
        arrays = dict(stored) | change
    np.savez(run.path / "frames.npz", **arrays)
    seal(run)
    with pytest.raises(SchemaError, match=r"frames\.npz"):
        open_sources([run])[0].motions(Made().cases)
