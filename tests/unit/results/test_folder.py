"""Folders that a report may replace, and those that hold someone's work."""

import json

import pytest

from nsf.errors import ConfigError
from nsf.pipeline.sweeps.experiment import Experiment
from nsf.results.folder import MARK, check_place, replaced

CONTENT = {"title": "Heap", "runs": {}, "files": {"index.md": "00"}}


@pytest.fixture
def report(tmp_path):
    """A folder as a report leaves it."""
    folder = tmp_path / "reports" / "heap"
    folder.mkdir(parents=True)
    (folder / MARK).write_text(json.dumps(CONTENT))
    (folder / "index.md").write_text("a page")
    return folder


def rewrite(folder):
    with replaced(folder) as fresh:
        (fresh / MARK).write_text(json.dumps(CONTENT))


def test_a_report_is_replaced(report):
    rewrite(report)
    assert [path.name for path in report.iterdir()] == [MARK]


@pytest.mark.parametrize("name", ["thesis.tex", ".git/HEAD", "index.md/notes"])
def test_work_beside_a_report_survives(report, name):
    (report / "index.md").unlink()
    (report / name).parent.mkdir(exist_ok=True)
    (report / name).write_text("three years")
    for attempt in (check_place, rewrite):
        with pytest.raises(ConfigError, match=rf"no report wrote its {name.split('/')[0]}.*; name another"):
            attempt(report)
    assert (report / name).read_text() == "three years"


@pytest.mark.parametrize(
    "text",
    [
        *("", "[]", "{}", "5", '"files"', "[" * 100_000, json.dumps({"files": ["thesis.tex"]})),
        *(json.dumps(CONTENT | change) for change in ({"files": []}, {"runs": None}, {"title": 3})),
    ],
)
def test_sources_of_another_program_are_none(report, text):
    (report / MARK).write_text(text)
    with pytest.raises(ConfigError, match=f"its {MARK} is of another program"):
        rewrite(report)
    assert (report / "index.md").exists()


def test_a_report_of_a_fresh_clone_is_replaced(report):
    """Of a committed report there are some files, which provenance.json names, and no record of its own."""
    (report / MARK).unlink()
    (report / "delta.png").touch()
    texts = {"question": "How far?", "paper": "", "missing": [], "plots": None}
    empty = {**CONTENT, **texts, "trained": {}, "logarithmic": [], "pictures": {}, "charts": {}}
    records = {
        "heap": {**empty, "charts": {"delta.png": "00"}},
        "other": {**empty, "files": {"thesis.tex": "0"}},
    }
    (report.parent / "provenance.json").write_text(json.dumps(records))
    check_place(report)
    (report / "thesis.tex").touch()
    with pytest.raises(ConfigError, match=f"it has no {MARK}"):
        rewrite(report)
    (report.parent / "provenance.json").write_text("[]")
    with pytest.raises(ConfigError, match="is of another program"):
        rewrite(report)
    assert (report / "thesis.tex").exists()


def test_what_a_killed_process_left_is_put_back(report):
    work = report.with_name(".heap.partial")
    (work / "new").mkdir(parents=True)
    report.rename(work / "old")
    with pytest.raises(KeyboardInterrupt), replaced(report):
        raise KeyboardInterrupt
    assert (report / "index.md").read_text() == "a page"
    assert not work.exists()


def test_an_experiment_from_elsewhere_writes_no_report_outside(tmp_path, monkeypatch):
    monkeypatch.setenv("NSF_REPORTS", str(tmp_path / "reports"))
    jobs = f"each: {{report.folder: {tmp_path / 'home'}}}\njobs: [{{scene: sand}}]"
    (tmp_path / "mine.yaml").write_text(f"title: A\nquestion: B\npaper: C\n{jobs}")
    with pytest.raises(ConfigError, match=r"lies outside of the reports folder .*; give report\.folder="):
        Experiment.load("mine", folder=tmp_path).check_report_folder()
    Experiment.load("mine", [f"report.folder={tmp_path / 'home'}"], folder=tmp_path).check_report_folder()
    monkeypatch.setenv("NSF_REPORTS", str(tmp_path))
    Experiment.load("mine", folder=tmp_path).check_report_folder()
