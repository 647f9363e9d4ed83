"""A report killed while it is written: the old one stays, and the next is as an undisturbed one."""

import json
import signal

import pytest
from forked import BriefReport, PlainReport, SignalAt, run_nsf

from nsf.results.folder import MARK
from nsf.storage import locked

#: In the middle of the pictures, before the page, and between the two renames of the exchange.
MOMENTS = {
    "drawing": ("nsf.results.report:save", 2),
    "writing": ("nsf.results.report:markdown_page", 1),
    "exchanging": ("nsf.results.folder:Path.rename", 2),
}


def files(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def out_of_date(folder):
    """Let a report be drawn anew, as where its runs have changed."""
    told = json.loads((folder / MARK).read_text())
    (folder / MARK).write_text(json.dumps(told | {"made_of": "something else"}))


@pytest.fixture(scope="module")
def undisturbed(chain, tiny, tmp_path_factory):
    """The files of a report that nothing interrupted."""
    work = tmp_path_factory.mktemp("undisturbed")
    assert run_nsf(["report", *tiny], chain.root, work, BriefReport()).code == 0
    (folder,) = (path for path in (work / "reports").iterdir() if path.is_dir())
    return folder.name, files(folder)


@pytest.mark.slow
@pytest.mark.parametrize("moment", MOMENTS)
def test_a_report_that_was_killed(chain, nsf, tmp_path, undisturbed, moment):
    name, expected = undisturbed
    reports = tmp_path / "work/reports"
    assert nsf("report", chain.root, faults=[PlainReport()]).code == 0
    out_of_date(reports / name)
    old = files(reports / name)
    assert old != expected

    where, call = MOMENTS[moment]
    for kind in (signal.SIGTERM, signal.SIGKILL):
        outcome = nsf("report", chain.root, faults=[BriefReport(), SignalAt(where, call, kind)])
        assert outcome.code == (130 if kind == signal.SIGTERM else -signal.SIGKILL), outcome.err
        left = [path for path in reports.iterdir() if ".new-" in path.name or ".old-" in path.name]
        assert bool(left) == (kind == signal.SIGKILL)
        aside = [path for path in left if ".old-" in path.name]
        assert bool(aside) == (kind == signal.SIGKILL and moment == "exchanging")
        assert files(aside[0] if aside else reports / name) == old

    assert nsf("report", chain.root, faults=[BriefReport()]).code == 0
    assert files(reports / name) == expected
    assert {path.name for path in reports.iterdir()} == {name, f".{name}.lock"}


@pytest.mark.slow
def test_a_report_that_a_killed_process_had_put_aside_comes_back(chain, nsf, tmp_path, undisturbed):
    """Even where the next report is of something else."""
    name, _ = undisturbed
    reports = tmp_path / "work/reports"
    assert nsf("report", chain.root, faults=[PlainReport()]).code == 0
    out_of_date(reports / name)
    old = files(reports / name)
    killed = SignalAt(*MOMENTS["exchanging"], signal.SIGKILL)
    assert nsf("report", chain.root, faults=[BriefReport(), killed]).code < 0
    assert not (reports / name).exists()
    assert nsf("report", chain.root, "report.name=other", faults=[PlainReport()]).code == 0
    assert files(reports / name) == old
    assert {path.name for path in reports.iterdir()} == {name, f".{name}.lock", "other", ".other.lock"}


def test_what_a_living_process_writes_is_left_alone(chain, nsf, tmp_path):
    reports = tmp_path / "work/reports"
    for name in (".mine.new-abcdefgh", ".dead.new-abcdefgh", ".dead.old-abcdefgh"):
        (reports / name).mkdir(parents=True)
        (reports / name / "page").touch()
    (reports / ".dead.lock").touch()
    content = {"title": "", "runs": {}, "files": {"page": ""}}
    (reports / ".dead.old-abcdefgh" / MARK).write_text(json.dumps(content))
    with locked(reports / ".mine.lock"):
        assert nsf("report", chain.root, faults=[PlainReport()]).code == 0
        assert (reports / ".mine.new-abcdefgh/page").exists()
    assert not (reports / ".dead.new-abcdefgh").exists()
    assert (reports / "dead/page").exists()
    (written,) = (path.parent for path in reports.glob(f"*/{MARK}") if path.parent.name != "dead")
    out_of_date(written)
    assert nsf("report", chain.root, faults=[PlainReport()]).code == 0
    assert not (reports / ".mine.new-abcdefgh").exists()
