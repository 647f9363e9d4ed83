"""The outcome of each job of a sweep, in a table over the keys that it varied."""

import csv
from collections.abc import Mapping, Sequence
from statistics import fmean

from rich.markup import escape
from rich.table import Table

from nsf import config as configuration
from nsf.errors import MissingRunError
from nsf.pipeline.chain import Pipeline
from nsf.results.columns import COLUMNS
from nsf.runs import Run

#: Columns of `results.csv` of which a job's mean is shown.
_SHOWN = ("delta", "displacement_error", "stress_error", "step_ms_full", "step_ms")


def outcome_table(sweeps: Sequence[Sequence[str]], failed: Mapping[str, str]) -> Table | None:
    """A row a job; None where there is only one.

    Args:
        sweeps: overrides whose keys may have several values.
        failed: error by what tells the job apart, as of `nsf.pipeline.sweep.Failure`.
    """
    jobs = [dict(override.split("=", 1) for override in job) for job in configuration.jobs(sweeps)]
    keys = list(dict.fromkeys(key for job in jobs for key in job))
    varied = [key for key in keys if len({job.get(key) for job in jobs}) > 1]
    if len(jobs) < 2 or not varied:
        return None
    table = Table(box=None, header_style="bold", pad_edge=False)
    leaves = [key.split(".")[-1] for key in varied]
    for key, leaf in zip(varied, leaves, strict=True):
        table.add_column(escape(leaf if leaves.count(leaf) == 1 else key), overflow="fold")
    for name in _SHOWN:
        table.add_column(escape(COLUMNS[name].heading), justify="right")
    table.add_column("run", no_wrap=True)
    for job in jobs:
        setting = " ".join(f"{key}={job[key]}" for key in keys if key in varied and key in job)
        try:
            run = Pipeline(configuration.load([f"{key}={value}" for key, value in job.items()])).evaluated()
            cells = [*_means(run), run.hash]
        except MissingRunError:
            cells = [""] * len(_SHOWN) + ["failed" if setting in failed else "not evaluated"]
        table.add_row(*(escape(job.get(key, "")) for key in varied), *map(escape, cells))
    return table


def _means(run: Run) -> list[str]:
    """Cells of a job: means over its cases. Without pandas, whose import takes as long as a chain reused."""
    with run.file("results.csv").open(encoding="utf-8", newline="") as stream:
        rows = list(csv.DictReader(stream))
    return [COLUMNS[name].cell(fmean(float(row[name] or "nan") for row in rows)) for name in _SHOWN]
