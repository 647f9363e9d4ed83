"""A folder of reports as one: its table, page and charts, and what is noticed of a change."""

import json
import shutil
from pathlib import Path

import pytest
from made import Made, write_run
from PIL import Image

from nsf.cli import main
from nsf.errors import SchemaError
from nsf.results import committed, pictures, style, table
from nsf.results.page import Picture, Section
from nsf.results.question import Question
from nsf.results.report import build_report


def body(frame, sources, folder, question, films, advance):
    """A stand-in for pictures of bodies."""
    Image.new("RGB", (8, 8), "white").save(folder / "strip.png")
    return [Section("Bodies", [Picture(["strip.png"], "A body.", sorted(set(frame["run"])))])]


CONTENTS = """
chapters: {Main results: [table1/seeds], Choices of the method: [noise]}
paper: {Table 1: {shows: seven scenes, here: [table1/seeds/delta.png, none.png]}}
"""


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Runs and two reports of them, as `nsf report` and `nsf reports` write them."""
    root = tmp_path_factory.mktemp("made")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pictures, "sections", body)
        for name, delta in (("table1/seeds", 0.01), ("noise/weak", 0.02)):
            run = write_run(root / "runs", Made((delta, delta)))
            build_report([run], root / "reports" / name, Question(name, f"Title of {name}", plots=["delta"]))
    (root / "reports/contents.yaml").write_text(CONTENTS)
    committed.write_list(root / "reports")
    return root


@pytest.fixture
def folder(made, tmp_path, monkeypatch):
    monkeypatch.setattr(pictures, "sections", body)
    return Path(shutil.copytree(made / "reports", tmp_path / "reports"))


def faults(folder) -> list[str]:
    return [fault.replace(f"{folder}/", "") for fault in committed.faults(folder)]


def test_rows_of_all_reports_are_one_table(folder):
    frame = table.read(folder / "results.csv")
    assert frame.groupby("report")["delta"].mean().to_dict() == {"noise/weak": 0.02, "table1/seeds": 0.01}
    content = json.loads((folder / "provenance.json").read_text())
    assert {run for record in content.values() for run in record["runs"]} == set(frame["run"])
    assert [set(record["files"]) for record in content.values()] == [{"strip.png"}, {"strip.png"}]


def test_a_report_that_is_made_anew_takes_the_place_of_its_rows(folder, tmp_path):
    run = write_run(tmp_path / "runs", Made((0.05, 0.07)))
    build_report([run], folder / "noise/weak", Question("noise/weak", "New", plots=["delta"]))
    committed.write_list(folder)
    frame = table.read(folder / "results.csv")
    assert frame.groupby("report")["delta"].mean().to_dict() == pytest.approx(
        {"noise/weak": 0.06, "table1/seeds": 0.01}
    )


def test_the_table_and_pictures_suffice(folder):
    """As in a clone, which has neither the runs nor the pages of the reports."""
    for path in folder.rglob("*"):
        if path.parent != folder and path.is_file() and path.name != "strip.png":
            path.unlink()
    committed.write_list(folder, pages=True)
    assert faults(folder) == []
    assert (folder / "noise/weak/index.html").is_file()
    assert (folder / "noise/weak/delta.svg").is_file()


def test_what_was_changed_is_named_with_its_remedy(folder, capsys):
    assert faults(folder) == []
    Image.new("RGB", (8, 8), "black").save(folder / "noise/weak/strip.png")
    (folder / "table1/seeds/strip.png").unlink()
    with Image.open(folder / "noise/weak/delta.png") as image:
        Image.new("RGB", image.size, "black").save(folder / "noise/weak/delta.png")
    (folder / "index.md").write_text("other")
    again = f"write it with `nsf reports folder={folder}`".replace(f"{folder}/", "")
    assert faults(folder) == [
        "noise/weak/strip.png was changed; build it again with `nsf report`",
        "table1/seeds/strip.png is missing; build it again with `nsf report`",
        f"noise/weak/delta.png is not the chart of results.csv; {again}",
        f"index.md does not list the reports as they are; {again}",
    ]
    with pytest.raises(SystemExit) as ended:
        main(["reports", f"folder={folder}", "check=true"])
    assert ended.value.code == 2
    assert "strip.png was changed" in capsys.readouterr().err


def test_a_row_that_was_changed_is_noticed_by_its_charts_and_page(folder):
    frame = table.read(folder / "results.csv")
    frame.loc[frame["report"] == "noise/weak", "delta"] *= 1.001  # less than a pixel of the chart
    table.write(frame, folder / "results.csv")
    named = [fault.partition(" ")[0] for fault in faults(folder)]
    assert "noise/weak/delta.png" in named
    assert "table1/seeds/delta.png" not in named
    committed.write_list(folder)
    assert faults(folder) == []


def test_a_chart_that_is_drawn_otherwise_is_noticed_and_drawn_again(folder, monkeypatch):
    before = (folder / "noise/weak/delta.png").read_bytes()
    monkeypatch.setitem(style.MODEL_COLORS, "projected", "#00ff00")
    assert any("noise/weak/delta.png is not the chart" in fault for fault in faults(folder))
    committed.write_list(folder)
    assert faults(folder) == []
    assert (folder / "noise/weak/delta.png").read_bytes() != before


def test_a_chart_that_no_report_has_any_more_is_noticed(folder):
    frame = table.read(folder / "results.csv")
    table.write(frame[frame["report"] != "noise/weak"], folder / "results.csv")
    assert any("noise/weak/delta.png is not the chart" in fault for fault in faults(folder))


def test_a_half_written_provenance_is_refused(folder):
    (folder / "provenance.json").write_text('{"noise/weak": {}}')
    with pytest.raises(SchemaError, match=r"provenance\.json: noise/weak lacks title; .* take it from git"):
        committed.faults(folder)
    (folder / "provenance.json").write_text("{}")
    with pytest.raises(SchemaError, match=r"provenance\.json has no record of noise/weak; take it from git"):
        committed.faults(folder)


def test_a_report_with_files_of_its_own_is_listed_and_checked(folder):
    own = folder / "calibration"
    own.mkdir()
    (own / "index.md").write_text("# Calibration")
    listed = {"headings": ["", "off"], "body": [["a", "1"]], "numeric": [False, True], "made": "1 run."}
    (own / "sources.json").write_text(
        json.dumps({"title": "Calibration", "listed": listed, "files": {}, "runs": {}})
    )
    committed.write_list(folder)
    assert "### Calibration" in (folder / "index.md").read_text()
    content = json.loads((own / "sources.json").read_text()) | {"files": {"index.md": "0", "page.html": "0"}}
    (own / "sources.json").write_text(json.dumps(content))
    assert "calibration/index.md was changed; build it again with `nsf report`" in faults(folder)
