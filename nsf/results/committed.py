"""A folder of reports as one: one table of all their rows, one page, one picture a chart.

`reports/results.csv` is the table, with the name of the report in each row; `provenance.json` has the
question of each report, the origin of each run, the sha256 of each picture that runs alone can make, and of
each chart one of its file and of all that it draws. `index.md` and the charts are made of these two, in the
order of `contents.yaml`. Reports of inverse problems and benchmarks, whose rows are no cases, keep files of
their own and are listed.
"""

import hashlib
import html
import re
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
from nsf.results.folder import MARK
from nsf.results.formats import Rows, markdown_document
from nsf.results.page import Picture, Section
from nsf.results.question import Question
from nsf.results.style import fingerprint, save
from nsf.runs.provenance import not_ignored
from nsf.schemas import Maybe
from nsf.storage import write_json, writing

TABLE, PROVENANCE, LIST, CONTENTS = "results.csv", "provenance.json", "index.md", "contents.yaml"
_PARTS = ("reports", "runs", "pictures", "charts")  # of the provenance
_COLUMNS = (
    *("body", "variant", "case", "paper_delta", "delta", "displacement_error", "displacement_interpolated"),
    *("speedup_decoded", "stress_error"),
)
_WIDE, _LONG = 7, 14  # columns and rows of a table of the page
_EXPLAINED = ("delta", "displacement_error", "stress_error", "displacement_interpolated")
_MADE_ANEW = (".gif", ".html", ".mp4", ".svg", ".tex")  # of a report, and not committed
_REBUILD = "build it again with `nsf report`"


_PROVENANCE = {key: {...: dict} for key in ("reports", "runs", "pictures")} | {Maybe("charts"): {...: str}}
_CONTENTS = {
    Maybe("note"): str,
    Maybe("chapters"): {...: [str]},
    Maybe("paper"): {...: {"shows": str, "here": [str]}},
}
_MARK = {
    Maybe("title"): str,
    Maybe("files"): {...: str},
    Maybe("chart"): ({"file": str}, None),
    Maybe("listed"): {"headings": [str], "body": [[str]], "numeric": [bool], "made": str},
}
#: Of a report that `nsf report` wrote.
_WRITTEN = {
    "name": str,
    "files": {...: str},
    "runs": {...: dict},
    "pictures": {...: {"caption": str, "runs": [str]}},
}


@dataclass(frozen=True)
class Reports:
    """A folder of reports: its table, texts, origins and pictures.

    Attributes:
        folder: the folder.
        frame: the table.
        texts: by report, what it says beside the table.
        runs: by run id, its origin.
        pictures: by path, caption, runs and sha256 of what was drawn from runs.
        charts: by path, `_seal` of what was drawn from the table.
        questions: by report, title, question and paper of its experiment, which say more than `texts`.
    """

    folder: Path
    frame: pd.DataFrame
    texts: Mapping[str, Mapping]
    runs: Mapping[str, Mapping]
    pictures: Mapping[str, Mapping]
    charts: Mapping[str, str]
    questions: Mapping[str, Mapping] = field(default_factory=dict)

    @classmethod
    def of(cls, folder: Path, questions: Mapping[str, Mapping] | None = None) -> "Reports":
        """Those of a folder, which may hold none.

        Raises:
            SchemaError: the table is none, or `provenance.json` lacks a key.
        """
        path = folder / PROVENANCE
        content = _read(path, _PROVENANCE) if path.is_file() else {}
        frame = table.read(folder / TABLE) if (folder / TABLE).is_file() else pd.DataFrame(columns=[*COLUMNS])
        return cls(folder, frame, *(content.get(key, {}) for key in _PARTS), questions or {})

    def collected(self) -> "Reports":
        """With every report that `nsf report` wrote in the folder, each in the place of its older rows."""
        whole = self
        for mark in sorted(self.folder.rglob(MARK)):
            content = _read(mark, _MARK)
            if "made_of" in content and not_ignored([mark.with_name("delta.png")]):
                whole = whole._with(mark.parent, _read(mark, _WRITTEN))
        return whole

    def _with(self, place: Path, content: Mapping) -> "Reports":
        rows, name = table.read(place / TABLE), str(content["name"])
        others = self.frame[self.frame["report"] != name]
        frame = pd.concat([others, rows], ignore_index=True) if len(others) else rows
        prefix = place.relative_to(self.folder).as_posix()
        drawn = {
            f"{prefix}/{file}": {**picture, "sha256": content["files"].get(file, "")}
            for file, picture in content["pictures"].items()
            if picture["caption"] not in {chart.caption for chart in CHARTS.values()}
        }
        older = {path: one for path, one in self.pictures.items() if not path.startswith(f"{prefix}/")}
        keys = ("title", "question", "paper", "missing", "plots", "trained", "logarithmic")
        texts = dict(self.texts) | {name: {key: content.get(key) for key in keys}}
        return replace(
            self, frame=frame, texts=texts, runs={**self.runs, **content["runs"]}, pictures=older | drawn
        )

    def save(self) -> None:
        """Write the table and what stands beside it, without runs that no row or picture is of."""
        runs = {*self.frame["run"], *(run for one in self.pictures.values() for run in one["runs"])}
        table.write(self.frame, self.folder / TABLE)
        content = {
            "reports": {name: self.texts[name] for name in sorted(self.texts)},
            "runs": {run: self.runs[run] for run in sorted(self.runs) if run in runs},
            "pictures": {path: self.pictures[path] for path in sorted(self.pictures)},
            "charts": dict(self.charts),
        }
        write_json(self.folder / PROVENANCE, content)

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
        whole = name.removesuffix("_small")
        chapters = self.contents["chapters"]
        for number, (heading, names) in enumerate(chapters.items()):
            for one in (whole, whole.partition("/")[0]):
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
        texts = {**self.texts.get(name, {}), **self.questions.get(name, {})}
        return Question(
            name, texts.get("title") or name, texts.get("question") or "", texts.get("paper") or "",
            missing=texts.get("missing") or (), plots=texts.get("plots"),
        )  # fmt: skip

    def figures(self, name: str) -> Iterator[tuple[str, Figure]]:
        """File stem and figure of each chart of a report."""
        for stem, _, figure in report.figures(self.views[name], self.question(name).plots):
            yield stem, figure

    @cached_property
    def views(self) -> dict[str, View]:
        """Each report as charts see it, by name."""
        return {name: self._view(name) for name in self.names}

    def _view(self, name: str) -> View:
        texts = self.texts.get(name, {})
        logarithmic = frozenset(texts.get("logarithmic") or ())
        return View(table.labelled(self.rows(name)), None, {}, texts.get("trained") or {}, logarithmic)

    def drawn(self, name: str) -> list[Picture]:
        """Pictures of a report that were drawn from runs."""
        drawn = {path: one for path, one in self.pictures.items() if path.rpartition("/")[0] == name}
        return [
            Picture([path.rpartition("/")[2]], str(one["caption"]), list(one["runs"]))
            for path, one in drawn.items()
        ]


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
        reports = replace(reports, charts=_drawn(reports))
        reports.save()
    with writing(folder / LIST) as partial:
        partial.write_text(_page(reports), encoding="utf-8")
    return folder / LIST


def faults(folder: Path, questions: Mapping[str, Mapping] | None = None) -> list[str]:
    """Differences from what was generated, each with its remedy: of pictures, charts, and their page.

    A chart is as it was if its file is, and would draw the same data: nothing is rendered.

    Args:
        folder, questions: as for `write_list`.

    Raises:
        SchemaError: the table is none, or a key is missing.
    """
    reports = Reports.of(folder, questions)
    differing = [fault for mark in _listed(folder) for fault in _changed(mark.parent)]
    for path, one in reports.pictures.items():
        if not (folder / path).is_file():
            differing.append(f"{folder / path} is missing; {_REBUILD}")
        elif digest(folder / path) != one["sha256"]:
            differing.append(f"{folder / path} was changed; {_REBUILD}")
    if missing := set(reports.frame["run"]) - set(reports.runs):
        differing.append(f"{folder / PROVENANCE} has no origin of {sorted(missing)[0]}; {_REBUILD}")
    again = f"write it with `nsf reports folder={folder}`"
    drawn = {
        f"{name}/{stem}.png": fingerprint(figure)
        for name in reports.names
        for stem, figure in reports.figures(name)
    }
    for path in sorted(drawn.keys() | reports.charts.keys()):
        if path not in drawn or reports.charts.get(path) != _seal(drawn[path], folder / path):
            differing.append(f"{folder / path} is not the chart of {folder / TABLE}; {again}")
    page = folder / LIST
    if not page.is_file() or page.read_text(encoding="utf-8") != _page(reports):
        differing.append(f"{page} does not list the reports as they are; {again}")
    return differing


def _drawn(reports: Reports) -> dict[str, str]:
    """Draw the charts that are not there as the table has them; gives the seals of all, by path."""
    seals = {}
    for name in reports.names:
        for stem, figure in reports.figures(name):
            path, data = f"{name}/{stem}.png", fingerprint(figure)
            file = reports.folder / path
            if reports.charts.get(path) != _seal(data, file):
                file.parent.mkdir(parents=True, exist_ok=True)
                save(figure, file.parent, stem, ("png",), [COLORS])
            seals[path] = _seal(data, file)
    return seals


def _seal(data: str, file: Path) -> str:
    """sha256 of a figure's fingerprint and of the file that shows it; empty where there is no file."""
    return hashlib.sha256(f"{data} {digest(file)}".encode()).hexdigest() if file.is_file() else ""


def _write_pages(reports: Reports, name: str) -> None:
    """The charts of a report as SVG, and its pages."""
    place, question, view = reports.folder / name, reports.question(name), reports.views[name]
    place.mkdir(parents=True, exist_ok=True)
    runs = {run: reports.runs[run] for run in sorted(set(view.frame["run"])) if run in reports.runs}
    charts = report.draw(view, place, question.plots)
    sections = [Section("Charts", charts), Section("Pictures", reports.drawn(name))]
    report.write_pages(question, place, sections, runs, view)


def _page(reports: Reports) -> str:
    """The text of `index.md`."""
    chapters: dict[str, list[dict]] = {heading: [] for heading in reports.contents["chapters"]}
    for name in reports.names:
        chapters[reports.place(name)[1]].append(_section(reports, name))
    for entry in (*map(_listed_section, _listed(reports.folder)), *map(_bench, _benches(reports.folder))):
        chapters[list(chapters)[-1]].append(entry)
    pictures = reports.pictures.keys() | reports.charts.keys()
    figures = [
        (figure, entry["shows"], [path for path in entry["here"] if path in pictures])
        for figure, entry in reports.contents["paper"].items()
    ]
    return markdown_document(
        "list.md",
        note=reports.contents["note"],
        chapters={heading: entries for heading, entries in chapters.items() if entries},
        definitions=report.definitions(_EXPLAINED),
        of_the_paper=figures if any(paths for *_, paths in figures) else [],
    )


def _section(reports: Reports, name: str) -> dict:
    """One report on the page."""
    view = reports.views[name]
    averages, said = table.averaged(view.frame), []
    if len(averages) > _LONG:
        averages = averages.loc[sorted(averages.groupby("body", sort=False)["delta"].idxmin().dropna())]
        said.append("The best of each scene.")
    if averages["variant"].nunique() == 1:
        said.append(f"Model: {averages['model_name'].iloc[0]}.")
    varying = [c for c in _COLUMNS if c != "variant" or averages[c].nunique() > 1]
    names = [c for c in varying if c in averages and not averages[c].isna().all()][:_WIDE]
    files = [Path(path).name for path in reports.charts if path.rpartition("/")[0] == name]
    first = next((file for file in files if file.startswith("delta-over")), files[0] if files else "")
    return {
        "name": name,
        "title": reports.question(name).title,
        "table": table.rows_of(averages, names),
        "said": " ".join([*said, *report.findings(view)[:1]]),
        "chart": first,
        "more": [file for file in [*files, *(p.files[-1] for p in reports.drawn(name))] if file != first],
        "made": _made(reports, name),
    }


def _made(reports: Reports, name: str) -> str:
    """How many runs, on what, at which scale and commit."""
    rows = reports.rows(name)
    runs = [reports.runs.get(run, {}) for run in rows["run"].unique()]
    scales = " and ".join(sorted({str(run["scale"]) for run in runs if run.get("scale")}))
    commits = ", ".join(sorted({report.commit_text(run) for run in runs}))
    devices = sorted({re.sub(r"^NVIDIA | \d+GB.*", "", device) for device in rows["device"]})
    return f"{len(runs)} run{'s' * (len(runs) > 1)}, {scales} scale, {', '.join(devices)}, {commits}"


def _read(path: Path, schema: Mapping) -> dict:
    try:
        return schemas.read(path, schema)
    except SchemaError as error:
        raise SchemaError(f"{path.parent}: {error}; write the report again, or take it from git") from error


def _listed(folder: Path) -> Iterator[Path]:
    """Marks of reports that have files of their own, as of inverse problems."""
    for mark in not_ignored(sorted(folder.rglob(MARK))):
        if "listed" in _read(mark, _MARK):
            yield mark


def _listed_section(mark: Path) -> dict:
    """A report that has its files, on the page: its first table, as its `sources.json` has it."""
    content = _read(mark, _MARK)
    rows = content["listed"]
    wide = [text[:_WIDE] for text in rows["body"]]
    return {
        "name": mark.parent.name,
        "title": content["title"],
        "table": Rows(rows["headings"][:_WIDE], wide, rows["numeric"][:_WIDE]),
        "said": "",
        "chart": (content.get("chart") or {}).get("file", ""),
        "more": [LIST],
        "made": rows["made"].rstrip("."),
    }


def _changed(folder: Path) -> list[str]:
    """Files of such a report that are not those whose hashes it holds."""
    recorded = _read(folder / MARK, _MARK).get("files", {})
    present = {path.name: digest(path) for path in sorted(folder.iterdir()) if path.name != MARK}
    missing = {name for name in recorded.keys() - present.keys() if not name.endswith(_MADE_ANEW)}
    changed = {name for name in recorded.keys() & present.keys() if recorded[name] != present[name]}
    return [
        *(f"{folder / name} is missing; {_REBUILD}" for name in sorted(missing)),
        *(f"{folder / name} was changed; {_REBUILD}" for name in sorted(changed)),
    ]


def _benches(folder: Path) -> list[Path]:
    """Folders that `nsf bench` wrote."""
    return [mark.parent for mark in not_ignored(sorted(folder.glob("*/bench.csv")))]


def _bench(folder: Path) -> dict:
    """Benchmarks on the page: their title and first chart."""
    text = (folder / LIST).read_text(encoding="utf-8")
    chart = re.search(r"^!\[.*\]\(([\w-]+\.png)\)$", text, re.MULTILINE)
    rows = table.parsed(folder / "bench.csv", ())
    devices, commits = (", ".join(sorted(rows[name].astype(str).unique())) for name in ("device", "commit"))
    return {
        "name": folder.name,
        "title": html.unescape(text.partition("\n")[0].removeprefix("# ")),
        "table": None,
        "said": "",
        "chart": chart[1] if chart else "",
        "more": [LIST],
        "made": f"{len(rows)} rows, {devices}, {commits}",
    }
