"""The list of reports, and what it notices."""

import json
import subprocess

import pytest

from nsf.cli import main
from nsf.errors import SchemaError
from nsf.reporting import committed


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


def test_the_list(folder):
    (line, _) = (folder / "index.md").read_text().splitlines()[-2:]
    assert line.startswith("| [Sand & friends](sand/index.md) | A reduced-order model")
    assert line.endswith("| 3 | 2024-05-01 | 1f2e3d4c5b6a, 1f2e3d4c5b6a + uncommitted changes |")


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
    (folder / "sand/delta.svg").rename(folder / "sand/other.svg")
    code, told = check(folder, capsys)
    assert code == 2
    assert "delta.svg is missing" in told
    assert "other.svg is not of the report" in told


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
    (folder / "sand/sources.json").write_text('{"title": "a", "question": "b", "runs": {}}')
    with pytest.raises(SchemaError, match=r"lacks files; build it again with `nsf report`"):
        committed.faults(folder)


@pytest.mark.parametrize("word", ["chekc=true", "check=yes", "check"])
def test_a_wrong_word_is_refused(word, capsys):
    with pytest.raises(SystemExit) as ended:
        main(["reports", word])
    assert ended.value.code == 2
    assert "check" in capsys.readouterr().err
