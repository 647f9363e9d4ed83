"""A report is written again only as far as what it is made of has changed."""

import json
import shutil
from dataclasses import replace

import pytest
from synthetic import TEST, Made, rewrite_manifest, seal, write_run

from nsf.reporting import build_report, pictures
from nsf.reporting.keeping import unchanged
from nsf.reporting.sources import Study

SMALL = {"particles": 30, "frames": 4, "parameters": TEST[:2], "splits": ("test",) * 2}


@pytest.fixture(scope="module")
def built(tmp_path_factory, few_pictures):
    """Two variants of one scene, and their report of few pictures beside them; not to be changed."""
    root = tmp_path_factory.mktemp("runs")
    runs = [write_run(root, Made(**SMALL)), write_run(root, Made(method="deformation_only", **SMALL))]
    with few_pictures():
        build_report(runs, root / "report", "Sand")
    return root, runs


@pytest.fixture
def runs(built, tmp_path):
    """A copy of the runs."""
    shutil.copytree(built[0], tmp_path, dirs_exist_ok=True)
    return [replace(run, root=tmp_path) for run in built[1]]


@pytest.fixture
def folder(runs, tmp_path):
    """A copy of their report."""
    return tmp_path / "report"


@pytest.fixture
def drawn(monkeypatch):
    """The prefixes of the variants whose few pictures are drawn."""
    monkeypatch.setattr(pictures, "MANY", 0)
    found, true = [], pictures._of_variant

    def noted(v, folder, prefix, *how, **more):
        found.append(prefix)
        return true(v, folder, prefix, *how, **more)

    monkeypatch.setattr(pictures, "_of_variant", noted)
    return found


def test_what_has_not_changed_stands(runs, folder, tmp_path):
    assert unchanged(tmp_path / "other", runs, "Sand") is None  # there is none
    page = folder / "index.html"
    assert unchanged(folder, runs, "Sand") == page
    assert unchanged(folder, reversed(runs), "Sand") == page
    assert unchanged(folder, runs, "Sands") is None
    assert unchanged(folder, runs[:1], "Sand") is None
    assert unchanged(folder, runs, "Sand", first=runs[0]) is None
    assert unchanged(folder, runs, "Sand", study=Study("?", "", {}, {}, [])) is None


@pytest.mark.parametrize("spoilt", ["index.md", "delta.png", "sources.json"])
def test_a_changed_or_missing_file_of_the_report_is_noticed(runs, folder, spoilt):
    (folder / spoilt).write_bytes((folder / spoilt).read_bytes()[:-1] + b" ")
    assert unchanged(folder, runs, "Sand") is None or spoilt == "sources.json"
    (folder / spoilt).unlink()
    assert unchanged(folder, runs, "Sand") is None


def test_a_changed_run_is_noticed(runs, folder):
    rewrite_manifest(runs[0], commit="f" * 40)
    assert unchanged(folder, runs, "Sand") is None


def test_a_file_that_was_changed_after_its_run_is_no_reason_to_stand(runs, folder):
    path = runs[0].path / "results.csv"
    path.write_text(path.read_text().replace("0", "1", 1))
    assert unchanged(folder, runs, "Sand") is None


def test_only_variants_whose_runs_changed_are_drawn(runs, folder, drawn):
    before = {path.name: path.read_bytes() for path in folder.glob("nsf-*")}
    table = runs[1].path / "results.csv"
    table.write_text(table.read_text().replace("cuda:0", "cuda:1"))
    seal(runs[1])
    build_report(runs, folder, "Sand")
    assert drawn == ["deformation_only-"]
    assert {path.name: path.read_bytes() for path in folder.glob("nsf-*")} == before
    told = json.loads((folder / "sources.json").read_text())
    assert {name for name in told["pictures"] if name.startswith("nsf-")} == set(before)


def test_a_picture_that_was_changed_is_drawn_again(runs, folder, drawn):
    before = (folder / "nsf-strip.png").read_bytes()
    (folder / "nsf-strip.png").write_bytes(b"another")
    build_report(runs, folder, "Sand")
    assert drawn == ["nsf-"]
    assert (folder / "nsf-strip.png").read_bytes() == before
