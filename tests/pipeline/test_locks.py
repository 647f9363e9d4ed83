"""Two processes on one data set: nothing is made twice, nothing is spoilt."""

import re

import pandas as pd
from forked import PlainReport, begin_nsf

from nsf.data import Trajectory
from nsf.runs import Run


def test_two_runs_at_once_share_the_work(tiny, tmp_path):
    root = tmp_path / "runs"

    def begin(name):
        return begin_nsf(["run", *tiny, f"report.name={name}"], root, tmp_path / name, PlainReport())

    outcomes = [end() for end in [begin("one"), begin("two")]]
    assert [outcome.code for outcome in outcomes] == [0, 0], [outcome.err for outcome in outcomes]
    said = "".join(outcome.out for outcome in outcomes)
    assert sum(map(int, re.findall(r"simulate: (\d+) trajectories in", said))) == 4
    for stage in ("train", "deploy", "evaluate"):
        assert len(re.findall(rf"^{stage}: inputs unchanged, reused", said, re.MULTILINE)) == 1
        assert len(Run.find(stage, root=root)) == 1
    for found in Run.find("simulate", root=root):
        assert found.complete
        Trajectory.open(found.path / "trajectory.h5").close()
    for name in ("one", "two"):
        assert len(pd.read_csv(tmp_path / name / "reports" / name / "results.csv")) == 1


def test_two_reports_at_once_leave_a_whole_one(tiny, copied, tmp_path):
    root = copied("simulate", "train", "deploy", "evaluate")
    both = [begin_nsf(["report", *tiny], root, tmp_path / "work", PlainReport()) for _ in range(2)]
    assert [end().code for end in both] == [0, 0]
    reports = tmp_path / "work/reports"
    assert [path.name for path in reports.iterdir() if not path.name.startswith(".")] == ["sand_small"]
    assert (reports / "sand_small/sources.json").is_file()
