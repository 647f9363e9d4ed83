"""The list of reports, and what it notices."""

import json
import re
import subprocess

import pandas as pd
import pytest
from finished import job, write_report

from nsf.cli import main
from nsf.errors import SchemaError
from nsf.paths import EXPERIMENTS
from nsf.reporting import committed, finer


@pytest.fixture
def folder(report, tmp_path):
    """A folder with a copy of a report's text, listed."""
    told = json.loads((report / "sources.json").read_text())
    for name in ("sand", "sand_small"):
        copy = tmp_path / "reports" / name
        copy.mkdir(parents=True)
        kept = ("index.md", "results.csv", "results.tex", "delta.svg")
        for file in kept:
            (copy / file).write_bytes((report / file).read_bytes())
        files = {file: told["files"][file] for file in kept}
        (copy / "sources.json").write_text(json.dumps(told | {"files": files}))
    committed.write_list(tmp_path / "reports")
    return tmp_path / "reports"


def check(folder, capsys) -> tuple[int, str]:
    with pytest.raises(SystemExit) as ended:
        main(["reports", f"folder={folder}", "check=true"])
    return ended.value.code or 0, capsys.readouterr().err


def test_a_section_has_question_table_chart_origin_and_link(folder):
    text = (folder / "index.md").read_text()
    section = text[text.index('<a id="sand"></a>') : text.index('<a id="sand_small"></a>')]
    marks = [
        "### Sand & friends",
        "A reduced-order model",
        "| scene | method | \\|S\\| |",
        "| sand | nsf | 50 |",
    ]
    marks += ["Shown: means", "3 runs at paper scale on cuda:0 in fp64, 2024-05-01, 1f2e3d4c5b6a, 1f2e"]
    marks += ["[The whole report](sand/index.md)"]
    places = [section.index(mark) for mark in marks]
    assert places == sorted(places)


def test_order_is_that_of_a_paper_whatever_the_names(tmp_path):
    names = ("apples", "sand", "latent_dim", "width", "extrapolation", "ablation_small", "table1", "ablation")
    for name in names:
        write_report(tmp_path / name, [job()])
    text = committed.write_list(tmp_path).read_text()
    found = re.findall(r'^(?:## (.*)|<a id="(.*)"></a>)$', text, re.MULTILINE)
    assert ["".join(pair) for pair in found] == [
        "Main results", "table1",
        "What the method needs", "ablation", "ablation_small", "width", "latent_dim",
        "Beyond what was trained", "extrapolation",
        "One scene in detail, and speed", "sand",
        "Further reports", "apples",
    ]  # fmt: skip
    assert "- Main results: [Table1](#table1)\n" in text


def test_each_figure_of_the_paper_links_to_its_like_where_that_is_there(tmp_path, monkeypatch):
    assert "The paper's figures" not in committed.write_list(tmp_path).read_text()
    write_report(tmp_path / "table1", [job()], chart="delta.png")
    wanted = (("Table 1", "seven scenes", ("table1", "delta.png")), ("Figure 4", "S", ("figures", "s.png")))
    monkeypatch.setattr(committed, "OF_THE_PAPER", wanted)
    text = committed.write_list(tmp_path).read_text()
    assert "| Table 1 | seven scenes | [table1/delta.png](table1/delta.png) |\n| Figure 4 | S | – |\n" in text


def test_figures_of_the_paper_are_sought_in_reports_that_have_a_place():
    placed = {name for names in committed.CHAPTERS.values() for name in names}
    sought = {picture for _, _, *pictures in committed.OF_THE_PAPER for picture in pictures}
    assert {name for name, _ in sought} <= placed
    committed_ones = EXPERIMENTS.parent / "reports"
    assert [picture for picture in sorted(sought) if not committed_ones.joinpath(*picture).is_file()] == []


def test_equal_titles_are_told_apart_by_the_names_of_the_reports(tmp_path):
    for name, title in (("a", "One"), ("b", "One"), ("c", "Two")):
        write_report(tmp_path / name, [job()])
        sources = json.loads((tmp_path / name / "sources.json").read_text())
        (tmp_path / name / "sources.json").write_text(json.dumps(sources | {"title": title}))
    text = committed.write_list(tmp_path).read_text()
    assert re.findall("^### (.*)$", text, re.MULTILINE) == ["One (a)", "One (b)", "Two"]


def test_the_paper_the_chart_and_what_is_missing(tmp_path):
    jobs = [job(**{"sampler.size": "50"}), job(**{"sampler.size": "20"}) | {"delta": float("inf")}]
    told = {"paper": "Section 6.3: 0.2 %.", "missing": ["a: not run", "b: not run"]}
    write_report(tmp_path / "sampler", jobs, chart="delta-over-sampler-size.png", **told)
    text = committed.write_list(tmp_path).read_text()
    assert "**The paper:** Section 6.3: 0.2 %." in text
    assert "![Sampler](sampler/delta-over-sampler-size.png)\n\nWhat the chart shows." in text
    assert "Missing jobs: 2" in text
    assert "∞: 1 of the 2 reduced runs diverged." in text


def test_maps_and_errors_over_cost_stand_below_the_main_chart(tmp_path):
    folder = write_report(tmp_path / "forcing", [job()], chart="delta.png")
    told = json.loads((folder / "sources.json").read_text())
    assert "error-map" not in committed.write_list(tmp_path).read_text()
    for name in committed.FURTHER:
        told["files"][name] = ""
    (folder / "sources.json").write_text(json.dumps(told))
    text = committed.write_list(tmp_path).read_text()
    shown = [re.escape(f"![{committed.FURTHER[name]}](forcing/{name})") for name in committed.FURTHER]
    places = [re.search(mark, text).start() for mark in (r"!\[Forcing\]\(forcing/delta.png\)", *shown)]
    assert places == sorted(places)
    told["chart"]["file"] = "error-map.png"
    (folder / "sources.json").write_text(json.dumps(told))
    assert committed.write_list(tmp_path).read_text().count("](forcing/error-map.png)") == 1


def test_a_report_of_before_these_keys_is_listed(tmp_path):
    """Such as tell neither paper, scale, keys, chart nor what is missing."""
    folder = write_report(tmp_path / "table1", [job(), job("bread")], chart="delta.png")
    told = json.loads((folder / "sources.json").read_text())
    del told["chart"]
    for run in told["runs"].values():
        del run["keys"], run["scale"]
    (folder / "sources.json").write_text(json.dumps(told))
    text = committed.write_list(tmp_path).read_text()
    assert "| sand | 0.400 | 0.100 |" in text
    assert "![Table1](table1/delta.png)" in text
    assert "2 runs on NVIDIA H200" in text
    assert committed.faults(tmp_path) == []


def test_benchmarks_are_listed_by_their_first_lines(tmp_path):
    folder = tmp_path / "speed"
    folder.mkdir()
    (folder / "index.md").write_text("# Speed\n\nTime of a step.\n\n## On X\n\n![Over P.](step.png)\n")
    (folder / "bench.csv").write_text("bench,device,commit\nscaling,X,1f2e\nbatch,X,3d4c+\n")
    text = committed.write_list(tmp_path).read_text()
    assert "### Speed\n\nTime of a step.\n\n![Over P.](speed/step.png)\n\nOver P.\n\n2 rows on X" in text
    assert "1f2e, 3d4c+. [The whole report](speed/index.md)." in text


def test_points_beyond_the_particles_have_their_means(tmp_path):
    folder = write_report(tmp_path / "super_resolution", [job(field="basis"), job(field="mlp")])
    rows = [
        dict.fromkeys((c.name for c in finer._COLUMNS), value) | {"field": field, "parameter": 1.0}
        for field, value in (("basis", 0.01), ("basis", 0.03), ("mlp", 0.5))
    ]
    frame = pd.DataFrame(rows)
    frame[["field", "parameter", *(c.name for c in finer._COLUMNS)]].to_csv(
        folder / "superresolution.csv", index=False
    )
    text = committed.write_list(tmp_path).read_text()
    assert "| field | points | displacement error at the points [%] |" in text
    assert "| basis | 0.0200 | 2 |" in text
    assert "| mlp | 0.500 | 50 |" in text


def test_every_file_of_a_report_has_its_hash(report):
    told = json.loads((report / "sources.json").read_text())["files"]
    assert told.keys() == {path.name for path in report.iterdir()} - {"sources.json"}


def test_untouched_reports_pass(folder, capsys):
    assert check(folder, capsys) == (0, "")


@pytest.mark.parametrize("name", ["results.csv", "delta.svg", "results.tex"])
def test_a_changed_file_is_named(folder, capsys, name):
    path = folder / "sand" / name
    path.write_text(path.read_text().replace("1", "2"))
    assert check(folder, capsys) == (2, f"{path} was changed; build it again with `nsf report`\n")


def test_missing_and_added_files_are_named(folder, capsys):
    (folder / "sand/results.csv").rename(folder / "sand/other.csv")
    code, told = check(folder, capsys)
    assert code == 2
    assert "results.csv is missing" in told
    assert "other.csv is not of the report" in told


def test_a_stale_list_is_named(folder, capsys):
    sources = folder / "sand/sources.json"
    sources.write_text(sources.read_text().replace("Sand &", "Gravel &"))
    assert "index.md does not list the reports as they are" in check(folder, capsys)[1]
    committed.write_list(folder)
    assert check(folder, capsys) == (0, "")
    (folder / "index.md").unlink()
    assert check(folder, capsys)[0] == 2


def test_what_git_ignores_is_not_listed(folder, capsys):
    subprocess.run(["git", "init", "-q", folder], check=True)
    (folder / ".gitignore").write_text("sand_small/\n")
    assert check(folder, capsys)[0] == 2
    assert "sand_small" not in committed.write_list(folder).read_text()
    (folder / "sand_small/results.csv").write_text("")
    assert check(folder, capsys) == (0, "")


def test_a_report_without_hashes_says_how_to_get_them(folder):
    (folder / "sand/sources.json").write_text('{"title": "a", "question": "b", "runs": {}, "rows": []}')
    with pytest.raises(SchemaError, match=r"lacks files; build it again with `nsf report`"):
        committed.faults(folder)


@pytest.mark.parametrize("word", ["chekc=true", "check=yes", "check"])
def test_a_wrong_word_is_refused(word, capsys):
    with pytest.raises(SystemExit) as ended:
        main(["reports", word])
    assert ended.value.code == 2
    assert "check" in capsys.readouterr().err
