"""A folder of reports as one: one table of all their rows, one page, one picture a chart.

`reports/results.csv` is the table, with the name of the report in each row; `provenance.json` has the record
of each report (`nsf.results.folder`), with the sha256 of each picture that runs alone can make, and of each
chart one of its file and of all that it draws. `index.md` and the charts are made of these two, in the order
of `contents.yaml`. Reports of inverse problems and benchmarks, whose rows are no cases, have files of their
own and are listed.
"""

import hashlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import pandas as pd
import yaml
from matplotlib.figure import Figure

from nsf import schemas
from nsf.errors import SchemaError
from nsf.manifest import digest
from nsf.results import report, table
from nsf.results.charts import CHARTS, View
from nsf.results.charts.cases import COLORS
from nsf.results.columns import COLUMNS
from nsf.results.committed.contents import INDEX, listed, page_of
from nsf.results.folder import COMMITTED, MARK, PROVENANCE, RECORD, read
from nsf.results.page import Picture, Section
from nsf.results.question import Question
from nsf.results.style import fingerprint, save
from nsf.runs.provenance import not_ignored
from nsf.schemas import Maybe
from nsf.storage import write_json, write_text

TABLE, CONTENTS = "results.csv", "contents.yaml"
_MADE_ANEW = (".gif", ".html", ".mp4", ".svg", ".tex")  # of a report, and not committed
_REBUILD = "build it again with `nsf report`"


_CONTENTS = {
    Maybe("note"): str,
    Maybe("chapters"): {...: [str]},
    Maybe("paper"): {...: {"shows": str, "here": [str]}},
}


@dataclass(frozen=True)
class Reports:
    """A folder of reports: its table, and the record of each.

    Attributes:
        folder: the folder.
        frame: the table.
        records: by report, its record: `files` are pictures drawn from runs, and `charts` has by file the
            `_seal` of a chart of the table.
        questions: by report, title, question and paper of its experiment, which say more than the records.
    """

    folder: Path
    frame: pd.DataFrame
    records: Mapping[str, Mapping]
    questions: Mapping[str, Mapping] = field(default_factory=dict)

    @classmethod
    def of(cls, folder: Path, questions: Mapping[str, Mapping] | None = None) -> "Reports":
        """Those of a folder, which may hold none.

        Raises:
            SchemaError: the table is none, or `provenance.json` lacks a key.
        """
        path = folder / PROVENANCE
        records = read(path, {...: COMMITTED}) if path.is_file() else {}
        frame = table.read(folder / TABLE) if (folder / TABLE).is_file() else pd.DataFrame(columns=[*COLUMNS])
        if lost := set(frame["report"]) - records.keys():
            raise SchemaError(
                f"{path} has no record of {min(lost)}; take it from git, or its rows out of {TABLE}"
            )
        return cls(folder, frame, records, questions or {})

    def collected(self) -> "Reports":
        """With every report that `nsf report` wrote below the folder, each in the place of its older rows."""
        frame, records = self.frame, dict(self.records)
        for mark in sorted(self.folder.rglob(f"*/{MARK}")):
            if not not_ignored([mark.with_name("delta.png")]) or "listed" in read(mark):
                continue
            name = mark.parent.relative_to(self.folder).as_posix()
            rows = table.read(mark.with_name(TABLE)).assign(report=name)
            others = frame[frame["report"] != name]
            frame = pd.concat([others, rows], ignore_index=True) if len(others) else rows
            charts = records.get(name, {}).get("charts", {})
            records[name] = _of_pictures(read(mark, RECORD)) | {"charts": charts}
        return replace(self, frame=frame, records=records)

    def save(self) -> None:
        """Write the table and the records of the reports in it, without runs that no row or picture is of."""
        table.write(self.frame, self.folder / TABLE)
        records = {}
        for name, rows in self.frame.groupby("report"):
            record = self.records[name]
            shown = {*rows["run"], *(run for one in record["pictures"].values() for run in one["runs"])}
            runs = {run: origin for run, origin in sorted(record["runs"].items()) if run in shown}
            records[name] = {**record, "runs": runs}
        write_json(self.folder / PROVENANCE, records)

    @cached_property
    def contents(self) -> dict[str, Any]:
        """`contents.yaml`: a note on all reports, those of each chapter, pictures of the paper's figures."""
        path = self.folder / CONTENTS
        content = yaml.safe_load(path.read_text(encoding="utf-8")) if path.is_file() else {}
        schemas.check(content, _CONTENTS, str(path))
        parts = {"note": "", "chapters": {"Results": []}, "paper": {}}
        return {name: content.get(name) or part for name, part in parts.items()}

    def place(self, name: str) -> tuple[int, str, int, str]:
        """Number and heading of a report's chapter, its place in there, and its name."""
        chapters = self.contents["chapters"]
        for number, (heading, names) in enumerate(chapters.items()):
            for one in (name, name.partition("/")[0]):
                if one in names:
                    return number, heading, names.index(one), name
        return len(chapters) - 1, list(chapters)[-1], 0, name

    @cached_property
    def names(self) -> list[str]:
        """The reports, in the order of the page."""
        return sorted(set(self.frame["report"]), key=self.place)

    def rows(self, name: str) -> pd.DataFrame:
        """The table of one report."""
        return self.frame[self.frame["report"] == name].reset_index(drop=True)

    def question(self, name: str) -> Question:
        """The question of a report."""
        texts = {**self.records[name], **self.questions.get(name, {})}
        return Question(
            name, texts["title"], texts["question"], texts["paper"],
            missing=texts["missing"], plots=texts["plots"],
        )  # fmt: skip

    def figures(self, name: str) -> Iterator[tuple[str, Figure]]:
        """File and figure of each chart of a report."""
        for stem, _, figure in report.figures(self.views[name], self.question(name).plots):
            yield f"{stem}.png", figure

    @cached_property
    def views(self) -> dict[str, View]:
        """Each report as charts see it, by name."""
        return {name: self._view(name) for name in self.names}

    def _view(self, name: str) -> View:
        record = self.records[name]
        return View(
            table.labelled(self.rows(name)), None, {}, record["trained"], frozenset(record["logarithmic"])
        )

    @property
    def seals(self) -> dict[str, str]:
        """The seal of each chart, by its path."""
        of = self.records.items()
        return {f"{name}/{file}": seal for name, record in of for file, seal in record["charts"].items()}

    def drawn(self, name: str) -> list[Picture]:
        """Pictures of a report that were drawn from runs."""
        drawn = self.records[name]["pictures"].items()
        return [Picture([file], one["caption"], one["runs"]) for file, one in drawn]


def write_list(folder: Path, pages: bool = False, questions: Mapping[str, Mapping] | None = None) -> Path:
    """Take in what `nsf report` wrote below a folder, draw the charts of all reports, and write their page.

    Args:
        folder: of reports.
        pages: write each report's HTML and LaTeX, and its charts as SVG, too.
        questions: title, question and paper of the experiments, by name.

    Returns:
        Its `index.md`.

    Raises:
        SchemaError: a file of the folder is no table, or lacks a key.
        StorageError: the disk refused a file.
    """
    reports = Reports.of(folder, questions).collected()
    if len(reports.frame):
        reports.save()
        reports = Reports.of(folder, questions)  # as another process would read it
        for name in reports.names if pages else ():
            _write_pages(reports, name)
        records = {name: {**reports.records[name], "charts": _drawn(reports, name)} for name in reports.names}
        reports = replace(reports, records=records)
        reports.save()
    return write_text(folder / INDEX, page_of(reports))


def faults(folder: Path, questions: Mapping[str, Mapping] | None = None) -> list[str]:
    """Differences from what was generated, each with its remedy: of pictures, charts, and their page.

    A chart is as it was if its file is, and would draw the same data: nothing is rendered.

    Args:
        folder, questions: as for `write_list`.

    Raises:
        SchemaError: the table is none, or a key is missing.
    """
    reports = Reports.of(folder, questions)
    again = f"write it with `nsf reports folder={folder}`"
    differing = [fault for mark in listed(folder) for fault in _changed(mark.parent)]
    for name, record in reports.records.items():
        differing += _altered(folder / name, record["files"])
    for name in reports.names:
        if missing := set(reports.rows(name)["run"]) - reports.records[name]["runs"].keys():
            differing.append(f"{folder / PROVENANCE} has no origin of {sorted(missing)[0]}; {_REBUILD}")
    drawn = {
        f"{name}/{file}": fingerprint(figure)
        for name in reports.names
        for file, figure in reports.figures(name)
    }
    seals = reports.seals
    for path in sorted(drawn.keys() | seals.keys()):
        if path not in drawn or seals.get(path) != _seal(drawn[path], folder / path):
            differing.append(f"{folder / path} is not the chart of {folder / TABLE}; {again}")
    page = folder / INDEX
    if not page.is_file() or page.read_text(encoding="utf-8") != page_of(reports):
        differing.append(f"{page} does not list the reports as they are; {again}")
    return differing


def _of_pictures(record: Mapping) -> dict:
    """The record of a report as it is committed: of its files those that were drawn from runs."""
    charts = {chart.caption for chart in CHARTS.values()}
    pictures = {file: one for file, one in record["pictures"].items() if one["caption"] not in charts}
    committed = {key: record[key] for key in RECORD if key in record}
    return committed | {
        "pictures": pictures,
        "files": {file: record["files"].get(file, "") for file in pictures},
    }


def _drawn(reports: Reports, name: str) -> dict[str, str]:
    """Draw the charts of a report that are not there as the table has them; gives all seals, by file."""
    seals, folder, recorded = {}, reports.folder / name, reports.records[name]["charts"]
    folder.mkdir(parents=True, exist_ok=True)
    for file, figure in reports.figures(name):
        data = fingerprint(figure)
        if recorded.get(file) != _seal(data, folder / file):
            save(figure, folder, Path(file).stem, ("png",), [COLORS])
        seals[file] = _seal(data, folder / file)
    return seals


def _seal(data: str, file: Path) -> str:
    """sha256 of a figure's fingerprint and of the file that shows it; empty where there is no file."""
    return hashlib.sha256(f"{data} {digest(file)}".encode()).hexdigest() if file.is_file() else ""


def _write_pages(reports: Reports, name: str) -> None:
    """The charts of a report as SVG, and its pages."""
    place, question, view = reports.folder / name, reports.question(name), reports.views[name]
    place.mkdir(parents=True, exist_ok=True)
    of = reports.records[name]["runs"]
    runs = {run: of[run] for run in sorted(set(view.frame["run"])) if run in of}
    charts = report.draw(view, place, question.plots)
    sections = [Section("Charts", charts), Section("Pictures", reports.drawn(name))]
    report.write_pages(question, place, sections, runs, view)


def _changed(folder: Path) -> list[str]:
    """Files of such a report that are not those whose hashes it holds."""
    recorded = read(folder / MARK)["files"]
    there = {
        name: sha256
        for name, sha256 in recorded.items()
        if not name.endswith(_MADE_ANEW) or (folder / name).is_file()
    }
    return _altered(folder, there)


def _altered(folder: Path, recorded: Mapping[str, str]) -> Iterator[str]:
    """Files of a report that are gone, or are not those whose sha256 its record has."""
    for name, sha256 in sorted(recorded.items()):
        if not (folder / name).is_file():
            yield f"{folder / name} is missing; {_REBUILD}"
        elif digest(folder / name) != sha256:
            yield f"{folder / name} was changed; {_REBUILD}"
