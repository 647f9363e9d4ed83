"""A report killed while it is written: the old one stays, and the next is as an undisturbed one."""

import json
import signal

import pytest
from forked import BriefReport, PlainReport, SignalAt, run_nsf

from nsf.results.folder import MARK

#: In the middle of the pictures, before the page, and between the two renames of the exchange.
MOMENTS = {
    "drawing": ("nsf.results.report:save", 2),
    "writing": ("nsf.results.page:markdown_page", 1),
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
        work = reports / f".{name}.partial"
        assert work.exists() == (kind == signal.SIGKILL)
        aside = work / "old"
        assert aside.exists() == (kind == signal.SIGKILL and moment == "exchanging")
        assert files(aside if aside.exists() else reports / name) == old

    assert nsf("report", chain.root, faults=[BriefReport()]).code == 0
    assert files(reports / name) == expected
    assert {path.name for path in reports.iterdir()} == {name, f".{name}.lock"}
